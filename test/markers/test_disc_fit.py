"""Models of discs with blurred edges, and their fit."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from body_tracking.core.compiled import compiled
from body_tracking.markers import disc_fit

EDGE = np.log(0.8)
MODELS = {
    "two discs": (disc_fit.OVERLAPPING, np.array([10.0, 10.0, 4.0, 1.0, 14.0, 11.0, 3.8, 0.9, EDGE])),
    "three discs": (
        disc_fit.OVERLAPPING,
        np.array([10.0, 10.0, 4.0, 1.0, 14.0, 11.0, 3.8, 0.9, 12.0, 14.0, 3.5, 1.1, EDGE]),
    ),
    "a disc that is cut": (disc_fit.CUT, np.array([10.0, 10.0, 4.0, 1.0, 0.5, 1.0, EDGE])),
    "a disc that moves": (disc_fit.MOVING, np.array([10.0, 10.0, 4.0, 1.0, 2.0, 1.0, EDGE])),
}


def brightness(kind: int, x: float, y: float, p: np.ndarray) -> tuple[float, np.ndarray]:
    order, gradient = np.argsort(-p[2:-1:4], kind="stable"), np.empty(len(p))
    room = np.empty((len(order), 4)), np.empty(len(p))
    return disc_fit.brightness(kind, x, y, p, float(np.exp(p[-1])), order, *room, gradient), gradient


@pytest.mark.parametrize("name", MODELS)
def test_the_gradient_is_that_of_finite_differences(name: str) -> None:
    kind, p = MODELS[name]
    steps = 1e-5 * np.eye(len(p))
    for x, y in np.random.default_rng(1).uniform(3.0, 20.0, (200, 2)):
        _, gradient = brightness(kind, x, y, p)
        differences = [(brightness(kind, x, y, p + s)[0] - brightness(kind, x, y, p - s)[0]) / 2e-5 for s in steps]
        # five nodes of the quadrature leave some 1e-5
        assert gradient == pytest.approx(np.array(differences), abs=1e-4)


def test_the_share_inside_two_edges_is_the_bivariate_normal_distribution() -> None:
    for u, v, correlation in np.random.default_rng(2).uniform([-3.0, -3.0, -0.9], [3.0, 3.0, 0.9], (40, 3)):
        expected = multivariate_normal(cov=[[1.0, correlation], [correlation, 1.0]]).cdf([u, v])
        share, density = disc_fit.normal(u)
        assert disc_fit.both(u, share, density, v, correlation)[0] == pytest.approx(expected, abs=1e-3)
        assert (share, density) == pytest.approx((norm.cdf(u), norm.pdf(u)), abs=1e-7)


@pytest.mark.parametrize("name", MODELS)
def test_a_fit_finds_the_parameters_that_made_the_pixels(name: str) -> None:
    kind, p = MODELS[name]
    x, y = np.meshgrid(np.arange(26.0), np.arange(26.0))
    values = [brightness(kind, *place, p)[0] for place in zip(x.ravel(), y.ravel(), strict=True)]
    pixels = np.stack([x.ravel(), y.ravel(), np.array(values), np.full(x.size, 1e-4)])
    start = p[:-1] + np.random.default_rng(3).uniform(-0.1, 0.1, len(p) - 1)
    found, information, _, plain = disc_fit.fit(kind, start, pixels, 10.0, np.inf)
    assert found == pytest.approx(p, abs=1e-2)
    assert plain < 1e-4 * x.size * 0.01
    assert np.linalg.eigvalsh(information).min() > 0.0


def test_a_loop_is_compiled_where_nothing_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    njit = numba.njit

    def without_cache(cache: bool = False, **options: object) -> object:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(numba, "njit", without_cache)
    assert compiled(lambda x: x + 1)(2) == 3
