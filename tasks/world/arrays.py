"""Names of the arrays' types; what a field or argument holds, its shape and unit, stands beside it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
F32 = NDArray[np.float32]
FloatArray = NDArray[np.floating[Any]]  # of either precision
Ints = NDArray[np.int64]
ShortInts = NDArray[np.int32]
Rows = NDArray[np.uint32]  # indices that never count from the end, which compiled code need not ask about
Indices = NDArray[np.intp]  # of another array: what np.flatnonzero and np.argsort give
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Image = NDArray[np.uint8]  # (H, W, 3) RGB
