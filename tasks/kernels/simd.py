"""Sixteen float32 side by side as one value, inside kernels only: a row of a tile, or one column each of 16 Gaussians.

A loop over 16 numbers may or may not become vector instructions, and what it adds up goes through memory. Values of
this type are vectors from the start and stay in registers; the processor's width does not change a result: each lane is
rounded by IEEE 754, and sums over lanes have one fixed order.
"""

import operator
from collections.abc import Callable
from itertools import zip_longest
from typing import Any, ClassVar

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
_VECTOR = ir.VectorType(ir.FloatType(), LANES)


class Lanes(types.Type):
    """The type of such a value."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


lanes = Lanes()


@register_model(Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _operator(function: Callable[..., Any], instruction: str) -> None:
    """Lets `function` of two Lanes be the LLVM `instruction`."""

    @infer_global(function)
    class _Template(ConcreteTemplate):
        cases: ClassVar = [signature(lanes, lanes, lanes)]

    @lower_builtin(function, lanes, lanes)
    def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return getattr(builder, instruction)(*arguments)


for _name, _instruction in (("add", "fadd"), ("sub", "fsub"), ("mul", "fmul"), ("truediv", "fdiv"), ("iadd", "fadd")):
    _operator(getattr(operator, _name), _instruction)


def _constant(values: Any) -> Any:
    return ir.Constant(_VECTOR, [ir.Constant(ir.FloatType(), float(np.float32(v))) for v in values])


def _order(places: list[int]) -> Any:
    return ir.Constant(ir.VectorType(ir.IntType(32), LANES), places)


@intrinsic
def fill(typing_context: Any, number: Any) -> Any:
    """The same float32 in every lane."""

    def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        nothing = ir.Constant(_VECTOR, ir.Undefined)
        one = builder.insert_element(nothing, arguments[0], ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(one, nothing, _order([0] * LANES))

    return lanes(types.float32), build


@intrinsic
def lane_indices(typing_context: Any) -> Any:
    """0, 1, 2, ... 15."""
    return lanes(), lambda context, builder, sig, arguments: _constant(range(LANES))


def _pointer(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    data = context.make_array(kind)(context, builder, value=array).data
    return builder.bitcast(builder.gep(data, [at]), _VECTOR.as_pointer())


@intrinsic
def load(typing_context: Any, array: Any, at: Any) -> Any:
    """Sixteen numbers of a contiguous float32 array, of any shape, from flat index `at` (uint64) on; unchecked."""

    def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return builder.load(_pointer(context, builder, sig.args[0], *arguments), align=4)

    return lanes(array, types.uint64), build


@intrinsic
def store(typing_context: Any, array: Any, at: Any, value: Any) -> Any:
    """The inverse of `load`."""

    def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _pointer(context, builder, sig.args[0], *arguments[:2]), align=4)
        return context.get_dummy_value()

    return types.none(array, types.uint64, lanes), build


@intrinsic
def prefetch(typing_context: Any, array: Any, at: Any) -> Any:
    """Has the cache line around flat index `at` (uint64) of a contiguous array fetched ahead of its use."""

    def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        data = context.make_array(sig.args[0])(context, builder, value=arguments[0]).data
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        place = builder.bitcast(builder.gep(data, [arguments[1]]), byte)
        builder.call(function, [place, *(ir.Constant(number, k) for k in (0, 3, 1))])  # to read, to keep, data
        return context.get_dummy_value()

    return types.none(array, types.uint64), build


def _call_llvm(builder: Any, name: str, arguments: Any) -> Any:
    """What one of LLVM's own functions makes of values of this type."""
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(arguments))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c in one rounding."""

    def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return _call_llvm(builder, "llvm.fma.v16f32", arguments)

    return lanes(lanes, lanes, lanes), build


@intrinsic
def sqrt(typing_context: Any, values: Any) -> Any:
    """Square roots; NaN of what is negative."""
    return lanes(lanes), lambda context, builder, sig, arguments: _call_llvm(builder, "llvm.sqrt.v16f32", arguments)


def _select_where(comparison: str) -> Any:
    """An intrinsic of a and b: a in the lanes where the comparison of them holds, b in the others."""

    @intrinsic
    def chosen(typing_context: Any, a: Any, b: Any) -> Any:
        def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
            return builder.select(builder.fcmp_ordered(comparison, *arguments), *arguments)

        return lanes(lanes, lanes), build

    return chosen


smaller, larger = _select_where("<"), _select_where(">")  # b where a is NaN


def _value_where(comparison: str) -> Any:
    """An intrinsic of a, b and a value: the value in the lanes where the comparison of a and b holds, 0 elsewhere."""

    @intrinsic
    def chosen(typing_context: Any, a: Any, b: Any, value: Any) -> Any:
        def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
            a, b, value = arguments
            return builder.select(builder.fcmp_ordered(comparison, a, b), value, _constant([0.0] * LANES))

        return lanes(lanes, lanes, lanes), build

    return chosen


where_at_least, where_below = _value_where(">="), _value_where("<")


@intrinsic
def sums(typing_context: Any, vectors: Any) -> Any:
    """The sum over the lanes of each of up to 16 Lanes in a tuple, in the order of the tuple; then zeros.

    Halves are added to halves, of two vectors at a time.
    """

    def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        zeros = _constant([0.0] * LANES)
        parts = cgutils.unpack_tuple(builder, arguments[0])
        for half in (8, 4, 2, 1):
            first = _order([k for k in range(2 * LANES) if k // half % 2 == 0])
            second = _order([k for k in range(2 * LANES) if k // half % 2 == 1])
            pairs = zip_longest(parts[::2], parts[1::2], fillvalue=zeros)
            parts = [
                builder.fadd(builder.shuffle_vector(a, b, first), builder.shuffle_vector(a, b, second))
                for a, b in pairs
            ]
        return parts[0]

    return lanes(vectors), build


@intrinsic
def greatest(typing_context: Any, values: Any) -> Any:
    """The largest of the lanes, none of which is NaN."""

    def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        values = arguments[0]
        for half in (8, 4, 2, 1):
            other = builder.shuffle_vector(values, values, _order([(k + half) % LANES for k in range(LANES)]))
            values = builder.select(builder.fcmp_ordered(">", values, other), values, other)
        return builder.extract_element(values, ir.Constant(ir.IntType(32), 0))

    return types.float32(lanes), build
