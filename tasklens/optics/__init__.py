"""Differentiable sequential ray optics; knows no network and no data set.

Conventions, stated once:

- Lengths in mm, wavelengths and pixel pitch in um, angles in radians. z runs along the light, from left to right.
- A surface has its vertex on the axis; its sag z = s(r) is positive to the right. A positive curvature has its centre
  on the right. `thickness[i]` is the axial distance from vertex i to vertex i + 1; the last one is the image distance.
- A field is the point (X, Y) in mm on the image plane where a pinhole of the specified focal length f puts it; its
  light is a collimated bundle with direction tangents (X / f, Y / f). Images and PSFs live in sensor coordinates:
  columns run along x, rows along y.
- Tangential is along the field, in the plane of axis and chief ray; sagittal is across it. On the axis tangential is y.
- A ray that is lost keeps its share of the launched light: it lowers energies and MTF. An RMS is of rays that arrive.
  Light that a clear aperture stops is no part of a cached PSF: it darkens an image, and exposure makes up for that.
"""
