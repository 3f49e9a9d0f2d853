"""Kinds of arrays, as signatures name them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.floating]
"""Numbers of single or double precision."""
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Image = NDArray[np.uint8]
"""Grey levels (height, width)."""
Complex = NDArray[np.complex128]
"""Points of a plane as y + iz."""
