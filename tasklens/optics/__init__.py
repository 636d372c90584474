"""Differentiable sequential ray optics, independent of networks and data sets.

Conventions:

- Lengths in mm, wavelengths and pixel pitch in um, angles in radians. z runs along the light, from left to right.
- A surface has its vertex on the axis; its sag z = s(r) is positive to the right. A positive curvature has its centre
  on the right. `thickness[i]` is the axial distance from vertex i to vertex i + 1; the last one is the image distance.
- A field is the point (X, Y) in mm on the image plane of a pinhole camera of the specified focal length f; its light is
  a collimated bundle with direction tangents (X / f, Y / f). An object at a finite distance has its point in that
  direction from the centre of the paraxial entrance pupil. Images and PSFs are in sensor coordinates: columns run along
  x, rows along y.
- A pupil point is a point of the unit disc. Its rays meet the stop surface at (x, y) = pupil point times radius of the
  stop, at every field and wavelength; the chief ray meets its centre. A stop in front of the lens is its own entrance
  pupil. Rays are aimed at a stop behind a refracting surface; a ray that cannot reach its stop point is lost.
- Every launched ray has the same weight, that of a small area of the stop. Where the entrance pupil is a distorted
  image of the stop, the energies of equal areas of the stop differ by the determinant of
  d(launch x, y) / d(pupil x, y). Spots, PSFs and MTFs leave it out; relative illumination does not.
- Tangential is along the field, in the plane of axis and chief ray; sagittal is across it. On the axis tangential is y.
- A wavefront is ahead of its reference where W > 0: the ray's optical path is shorter than that of the chief ray.
- Energies, PSFs and MTF are fractions of the light that passes the clear apertures, since exposure compensates
  vignetting; other lost rays lower them. RMS radii use the valid rays only.
"""
