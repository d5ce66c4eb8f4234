"""How large a number of a scene may be."""

from tasks.world.arrays import Array

# No road has a length [m], heading [rad] or speed [m/s] like it; kernels number cells and turns of a circle, which
# stops working far above it.
LARGEST = 1e8


def all_within(values: Array) -> bool:
    """Whether all values are finite and at most LARGEST in size; takes no memory of the values' own size."""
    return bool(values.max(initial=0.0) <= LARGEST and values.min(initial=0.0) >= -LARGEST)  # NaN is neither
