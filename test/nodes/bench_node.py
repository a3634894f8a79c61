"""A node of the tests that costs little to spin."""

from __future__ import annotations

from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription


class BenchNode(Node):
    """A node whose publishers and subscriptions handle no events of the middleware.

    A publisher or subscription has two handlers by default, and rclpy's executor sets up all of them anew for each
    message: a tenth of a processor in test_robot_safety.
    """

    def create_publisher(self, *arguments: Any, **options: Any) -> Publisher:
        """As in the base class."""
        options.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(*arguments, **options)

    def create_subscription(self, *arguments: Any, **options: Any) -> Subscription:
        """As in the base class."""
        options.setdefault("event_callbacks", SubscriptionEventCallbacks(use_default_callbacks=False))
        return super().create_subscription(*arguments, **options)
