"""A vehicle without a body is refused."""

from dataclasses import fields

import pytest

from tasks.world.frames import Vehicle


@pytest.mark.parametrize("length_m", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", [field.name for field in fields(Vehicle)])
def test_a_length_that_is_not_finite_and_positive_is_refused_by_name(name: str, length_m: float) -> None:
    with pytest.raises(ValueError, match=rf"vehicle\.{name} must be finite and positive"):
        Vehicle(**{name: length_m})
