"""Colour cameras: the joints of people in their images, lifted to three dimensions by depth images."""
