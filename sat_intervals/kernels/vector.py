"""Explicit vectors of 32 lanes for numba kernels: uint16, and float32 for correlation.

LLVM vectorises a plain loop over disparities only behind run-time checks that arrays do not overlap. They take longer
than the loop itself where a curve has two or four vectors. LLVM lowers these primitives to the registers of the
processor: one of AVX-512, two of AVX2, four of SSE2 or NEON.

Sums and differences wrap around. Comparisons are unsigned. A mask of lanes is a 32-bit number, lane 0 the lowest bit.
"""

from functools import update_wrapper

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

LANES = 32

_HALF = ir.IntType(16)
_WORD = ir.IntType(32)
_BYTES = ir.VectorType(ir.IntType(8), LANES)
_VECTOR = ir.VectorType(_HALF, LANES)
_WORDS = ir.VectorType(_WORD, LANES)
_FLOATS = ir.VectorType(ir.FloatType(), LANES)


class _VectorType(types.Type):
    """The numba type of a vector of 32 lanes."""

    def __init__(self, lane: str, kind: ir.VectorType) -> None:
        super().__init__(name=f"vector_32_{lane}")
        self.kind = kind


vector_type = _VectorType("uint16", _VECTOR)
float_vector_type = _VectorType("float32", _FLOATS)


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, kind.kind)


def _primitive(result, *parameters):
    """Make an intrinsic of a function that builds its instructions, ``build(builder, *values)``."""

    def intrinsic_of(build):
        def typed(typing_context, *arguments):
            return result(*parameters), lambda context, builder, signature, values: build(builder, *values)

        return intrinsic(update_wrapper(typed, build))  # numba counts the parameters of `build`

    return intrinsic_of


def _on_array(result, *parameters):
    """Make an intrinsic on a C-contiguous array of ``build(builder, its address, index, *values)``."""

    def intrinsic_of(build):
        def typed(typing_context, array, *arguments):
            def generate(context, builder, signature, values):
                data = context.make_array(array)(context, builder, values[0]).data
                built = build(builder, data, *values[1:])
                return context.get_dummy_value() if result is types.void else built

            return result(array, types.intp, *parameters), generate

        return intrinsic(update_wrapper(typed, build))

    return intrinsic_of


def _vector_at(builder, data, index, kind):
    """Address of the vector from the flat element ``index`` on."""
    return builder.bitcast(builder.gep(data, [index]), kind.as_pointer())


def _splat(builder, value, kind):
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_WORD, 0))
    zeros = ir.Constant(ir.VectorType(_WORD, kind.count), [0] * kind.count)
    return builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined), zeros)


def _call(builder, name, result, *arguments):
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


@_on_array(vector_type)
def load(builder, data, index):
    """Return ``array.ravel()[index : index + 32]`` of a uint16 array."""
    return builder.load(_vector_at(builder, data, index, _VECTOR), align=2)


@_on_array(types.void, vector_type)
def store(builder, data, index, vector):
    """Write a vector to ``array.ravel()[index : index + 32]``."""
    builder.store(vector, _vector_at(builder, data, index, _VECTOR), align=2)


@intrinsic
def load_costs(typing_context, array, index):
    """Return ``array.ravel()[index : index + 32]`` of a uint8 or uint16 array, as uint16 lanes."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(array)(context, builder, arguments[0]).data
        if array.dtype == types.uint8:
            return builder.zext(builder.load(_vector_at(builder, data, arguments[1], _BYTES), align=1), _VECTOR)
        return builder.load(_vector_at(builder, data, arguments[1], _VECTOR), align=2)

    return vector_type(array, types.intp), generate


@_on_array(float_vector_type)
def load_floats(builder, data, index):
    """Return ``array.ravel()[index : index + 32]`` of a float32 array."""
    return builder.load(_vector_at(builder, data, index, _FLOATS), align=4)


@_on_array(types.void, float_vector_type)
def store_rounded(builder, data, index, vector):
    """Write a float vector, rounded and clipped to 0 .. 255, to ``array.ravel()[index : index + 32]`` of uint8."""
    zeros, most, half = (ir.Constant(_FLOATS, [limit] * LANES) for limit in (0.0, 255.0, 0.5))
    value = builder.fadd(vector, half)
    value = builder.select(builder.fcmp_ordered(">", value, zeros), value, zeros)  # NaN becomes 0
    value = builder.select(builder.fcmp_ordered("<", value, most), value, most)
    words = builder.fptoui(value, _WORDS)
    builder.store(builder.trunc(words, _BYTES), _vector_at(builder, data, index, _BYTES), align=1)


@_primitive(float_vector_type, types.float32)
def splat_float(builder, value):
    """Return a vector with ``value`` in every lane."""
    return _splat(builder, value, _FLOATS)


@_primitive(float_vector_type, *3 * [float_vector_type])
def multiply_add(builder, first, second, total):
    """Lane by lane ``first * second + total``, rounded once where the processor can."""
    return _call(builder, f"llvm.fmuladd.v{LANES}f32", _FLOATS, first, second, total)


@_primitive(vector_type, types.uint16)
def splat(builder, value):
    """Return a vector with ``value`` in every lane."""
    return _splat(builder, value, _VECTOR)


@_primitive(vector_type, vector_type, vector_type)
def add(builder, first, second):
    """Lane by lane ``first + second``."""
    return builder.add(first, second)


@_primitive(vector_type, vector_type, vector_type)
def subtract(builder, first, second):
    """Lane by lane ``first - second``."""
    return builder.sub(first, second)


@_primitive(vector_type, vector_type, vector_type)
def smaller(builder, first, second):
    """Lane by lane ``min(first, second)``."""
    return _call(builder, f"llvm.umin.v{LANES}i16", _VECTOR, first, second)


@_primitive(vector_type, vector_type, vector_type)
def larger(builder, first, second):
    """Lane by lane ``max(first, second)``."""
    return _call(builder, f"llvm.umax.v{LANES}i16", _VECTOR, first, second)


@_primitive(vector_type, vector_type, vector_type)
def slide_up(builder, before, vector):
    """Return ``(before, vector)`` shifted: lane i holds element i - 1."""
    return builder.shuffle_vector(before, vector, ir.Constant(_WORDS, list(range(LANES - 1, 2 * LANES - 1))))


@_primitive(vector_type, vector_type, vector_type)
def slide_down(builder, vector, after):
    """Return ``(vector, after)`` shifted: lane i holds element i + 1."""
    return builder.shuffle_vector(vector, after, ir.Constant(_WORDS, list(range(1, LANES + 1))))


@_primitive(types.uint16, vector_type)
def smallest(builder, vector):
    """Return the smallest lane."""
    return _call(builder, f"llvm.vector.reduce.umin.v{LANES}i16", _HALF, vector)


@_primitive(types.uint32, vector_type, types.uint16)
def lanes_at_most(builder, vector, limit):
    """Return the mask of the lanes that are ``<= limit``."""
    return builder.bitcast(builder.icmp_unsigned("<=", vector, _splat(builder, limit, _VECTOR)), _WORD)


@_primitive(vector_type, vector_type)
def fill_where_nonzero(builder, vector):
    """Return 65535 in the nonzero lanes, 0 in the others."""
    return builder.sext(builder.icmp_unsigned("!=", vector, ir.Constant(_VECTOR, [0] * LANES)), _VECTOR)


@_primitive(vector_type, *3 * [vector_type])
def mix(builder, mask, first, second):
    """Return ``second`` in the lanes where the mask is 65535, ``first`` where it is 0."""
    return builder.xor(first, builder.and_(mask, builder.xor(first, second)))


@_primitive(vector_type, *4 * [vector_type])
def choose_smaller(builder, candidate, best, index, best_index):
    """Return ``index`` in the lanes where ``candidate <= best``, ``best_index`` in the others."""
    return builder.select(builder.icmp_unsigned("<=", candidate, best), index, best_index)


def _zeros_beside(builder, mask, name):
    zero_is_undefined = ir.Constant(ir.IntType(1), 1)
    return builder.zext(_call(builder, f"llvm.{name}.i32", _WORD, mask, zero_is_undefined), ir.IntType(64))


@_primitive(types.intp, types.uint32)
def first_lane(builder, mask):
    """Return the number of the lowest lane of a non-empty mask."""
    return _zeros_beside(builder, mask, "cttz")


@_primitive(types.intp, types.uint32)
def lanes_above_last(builder, mask):
    """Return the number of lanes above the highest lane of a non-empty mask."""
    return _zeros_beside(builder, mask, "ctlz")


@intrinsic
def hamming(typing_context, words, index, word):
    """Return the Hamming distances of 32 consecutive words of an array, contiguous uint32 or uint64, to one word."""

    def generate(context, builder, signature, arguments):
        array, index, word = arguments
        bits = words.dtype.bitwidth
        kind = ir.VectorType(ir.IntType(bits), LANES)
        pointer = _vector_at(builder, context.make_array(words)(context, builder, array).data, index, kind)
        differing = builder.xor(builder.load(pointer, align=bits // 8), _splat(builder, word, kind))
        counts = _call(builder, f"llvm.ctpop.v{LANES}i{bits}", kind, differing)
        return builder.trunc(counts, _VECTOR)

    return vector_type(words, types.intp, words.dtype), generate
