"""Refractive indices of optical plastics.

Schott's formula, n^2 = a0 + a1 w^2 + a2 / w^2 + a3 / w^4 + a4 / w^6 + a5 / w^8 with w in um, with the coefficients of
the Zemax AGF plastics catalogue (as distributed with DeepLens, Apache-2.0).
"""

import math

FITTED_UM = (0.4, 0.8)  # wavelengths that the coefficients were fitted to

PLASTICS = {
    "COC": (2.28449, 1.02952e-2, 3.73494e-2, -9.28410e-3, 1.73290e-3, -1.15203e-4),
    "PMMA": (2.18646, -2.44753e-4, 1.41558e-2, -4.43298e-4, 7.76643e-5, -2.99364e-6),
    "PS": (2.44598, 2.21429e-5, 2.72989e-2, 3.01211e-4, 8.88934e-5, -1.75708e-6),
    "PC": (2.42839, -3.86117e-5, 2.87574e-2, -1.97897e-4, 1.48359e-4, 1.38652e-6),
    "OKP4HT": (2.55219, 6.51282e-5, 3.57452e-2, 8.49831e-4, 8.47777e-5, 1.58990e-5),
    "OKP4": (2.49230, -1.46713e-3, 3.04056e-2, -2.31960e-4, 3.62928e-4, -1.89103e-5),
}


def refractive_index(medium: str, wavelength: float) -> float:
    """Index of `medium` ("air", whose index is 1, or a plastic) at `wavelength` [um].

    Raises:
        ValueError: unknown medium, or a wavelength outside the fitted range.
    """
    if medium == "air":
        return 1.0
    if medium not in PLASTICS:
        raise ValueError(f"unknown medium {medium!r}; expected air or one of {', '.join(sorted(PLASTICS))}")
    low, high = FITTED_UM
    if not low <= wavelength <= high:
        raise ValueError(f"{medium}: wavelength {wavelength} um is outside the fitted range {low} to {high} um")
    w2 = wavelength * wavelength
    a0, a1, a2, a3, a4, a5 = PLASTICS[medium]
    return math.sqrt(a0 + a1 * w2 + (a2 + (a3 + (a4 + a5 / w2) / w2) / w2) / w2)
