"""Explicit vectors of 32 lanes for numba kernels: uint16, and float32 for correlation.

LLVM vectorises a plain loop over disparities only behind run-time checks that arrays do not overlap. They take longer
than the loop itself where a curve has two or four vectors. LLVM lowers these primitives to the registers of the
processor: one of AVX-512, two of AVX2, four of SSE2 or NEON.

Sums and differences wrap around. Comparisons are unsigned. A mask of lanes is a 32-bit number, lane 0 the lowest bit.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

LANES = 32

_BYTE = ir.IntType(8)
_HALF = ir.IntType(16)
_WORD = ir.IntType(32)
_BYTES = ir.VectorType(_BYTE, LANES)
_VECTOR = ir.VectorType(_HALF, LANES)
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_LANE_INDEX = ir.VectorType(_WORD, LANES)


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


def _address(context, builder, array_type, array, index, pointee):
    """Pointer to the flat element ``index`` of a C-contiguous array, as a pointer to a vector."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), pointee.as_pointer())


def _splat(builder, value, kind):
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_WORD, 0))
    zeros = ir.Constant(ir.VectorType(_WORD, kind.count), [0] * kind.count)
    return builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined), zeros)


def _call(builder, name, result, arguments):
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


def _lane_mask(builder, lanes):
    return builder.bitcast(lanes, _WORD)


@intrinsic
def load(typing_context, array, index):
    """Return ``array.ravel()[index : index + 32]`` of a contiguous uint16 array."""

    def generate(context, builder, signature, arguments):
        pointer = _address(context, builder, signature.args[0], arguments[0], arguments[1], _VECTOR)
        return builder.load(pointer, align=2)

    return vector_type(array, types.intp), generate


@intrinsic
def store(typing_context, array, index, vector):
    """Write a vector to ``array.ravel()[index : index + 32]``."""

    def generate(context, builder, signature, arguments):
        pointer = _address(context, builder, signature.args[0], arguments[0], arguments[1], _VECTOR)
        builder.store(arguments[2], pointer, align=2)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def load_bytes(typing_context, array, index):
    """Return ``array.ravel()[index : index + 32]`` of a contiguous uint8 array, as uint16 lanes."""

    def generate(context, builder, signature, arguments):
        pointer = _address(context, builder, signature.args[0], arguments[0], arguments[1], _BYTES)
        return builder.zext(builder.load(pointer, align=1), _VECTOR)

    return vector_type(array, types.intp), generate


@intrinsic
def load_floats(typing_context, array, index):
    """Return ``array.ravel()[index : index + 32]`` of a contiguous float32 array."""

    def generate(context, builder, signature, arguments):
        pointer = _address(context, builder, signature.args[0], arguments[0], arguments[1], _FLOATS)
        return builder.load(pointer, align=4)

    return float_vector_type(array, types.intp), generate


@intrinsic
def splat_float(typing_context, value):
    """Return a vector with the float32 ``value`` in every lane."""

    def generate(context, builder, signature, arguments):
        return _splat(builder, arguments[0], _FLOATS)

    return float_vector_type(types.float32), generate


@intrinsic
def multiply_add(typing_context, first, second, total):
    """Lane by lane ``first * second + total`` of float vectors, rounded once where the processor can."""

    def generate(context, builder, signature, arguments):
        return _call(builder, f"llvm.fmuladd.v{LANES}f32", _FLOATS, arguments)

    return float_vector_type(first, second, total), generate


@intrinsic
def store_rounded(typing_context, array, index, vector):
    """Write a float vector, rounded and clipped to 0 .. 255, to ``array.ravel()[index : index + 32]`` of uint8."""

    def generate(context, builder, signature, arguments):
        array, index, value = arguments
        zeros, most, half = (ir.Constant(_FLOATS, [limit] * LANES) for limit in (0.0, 255.0, 0.5))
        value = builder.fadd(value, half)
        value = builder.select(builder.fcmp_ordered(">", value, zeros), value, zeros)  # NaN becomes 0
        value = builder.select(builder.fcmp_ordered("<", value, most), value, most)
        words = builder.fptoui(value, ir.VectorType(_WORD, LANES))
        pointer = _address(context, builder, signature.args[0], array, index, _BYTES)
        builder.store(builder.trunc(words, _BYTES), pointer, align=1)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def splat(typing_context, value):
    """Return a vector with ``value`` in every lane."""

    def generate(context, builder, signature, arguments):
        return _splat(builder, arguments[0], _VECTOR)

    return vector_type(types.uint16), generate


def _binary(name, operation, doc):
    @intrinsic
    def function(typing_context, first, second):
        def generate(context, builder, signature, arguments):
            return operation(builder, *arguments)

        return vector_type(vector_type, vector_type), generate

    function.__doc__ = doc
    return function


def _smaller(builder, first, second):
    return _call(builder, f"llvm.umin.v{LANES}i16", _VECTOR, (first, second))


def _larger(builder, first, second):
    return _call(builder, f"llvm.umax.v{LANES}i16", _VECTOR, (first, second))


def _slide_up(builder, before, vector):
    lanes = ir.Constant(_LANE_INDEX, list(range(LANES - 1, 2 * LANES - 1)))
    return builder.shuffle_vector(before, vector, lanes)


def _slide_down(builder, vector, after):
    lanes = ir.Constant(_LANE_INDEX, list(range(1, LANES + 1)))
    return builder.shuffle_vector(vector, after, lanes)


add = _binary("add", lambda builder, a, b: builder.add(a, b), "Lane by lane ``a + b``.")
subtract = _binary("subtract", lambda builder, a, b: builder.sub(a, b), "Lane by lane ``a - b``.")
smaller = _binary("smaller", _smaller, "Lane by lane ``min(a, b)``.")
larger = _binary("larger", _larger, "Lane by lane ``max(a, b)``.")
slide_up = _binary("slide_up", _slide_up, "Return ``(before, vector)`` shifted: lane i holds element i - 1.")
slide_down = _binary("slide_down", _slide_down, "Return ``(vector, after)`` shifted: lane i holds element i + 1.")


@intrinsic
def smallest(typing_context, vector):
    """Return the smallest lane."""

    def generate(context, builder, signature, arguments):
        return _call(builder, f"llvm.vector.reduce.umin.v{LANES}i16", _HALF, arguments)

    return types.uint16(vector), generate


@intrinsic
def lanes_at_most(typing_context, vector, limit):
    """Return the mask of the lanes that are ``<= limit``."""

    def generate(context, builder, signature, arguments):
        limits = _splat(builder, arguments[1], _VECTOR)
        return _lane_mask(builder, builder.icmp_unsigned("<=", arguments[0], limits))

    return types.uint32(vector, types.uint16), generate


@intrinsic
def fill_where_nonzero(typing_context, vector):
    """Return 65535 in the nonzero lanes, 0 in the others."""

    def generate(context, builder, signature, arguments):
        zeros = ir.Constant(_VECTOR, [0] * LANES)
        return builder.sext(builder.icmp_unsigned("!=", arguments[0], zeros), _VECTOR)

    return vector_type(vector), generate


@intrinsic
def mix(typing_context, mask, first, second):
    """Return ``second`` in the lanes where the mask is 65535, ``first`` where it is 0."""

    def generate(context, builder, signature, arguments):
        mask, first, second = arguments
        return builder.xor(first, builder.and_(mask, builder.xor(first, second)))

    return vector_type(mask, first, second), generate


@intrinsic
def choose_smaller(typing_context, candidate, best, index, best_index):
    """Return ``index`` in the lanes where ``candidate <= best``, ``best_index`` in the others."""

    def generate(context, builder, signature, arguments):
        candidate, best, index, best_index = arguments
        return builder.select(builder.icmp_unsigned("<=", candidate, best), index, best_index)

    return vector_type(candidate, best, index, best_index), generate


def _bit_count(name, doc):
    @intrinsic
    def function(typing_context, mask):
        def generate(context, builder, signature, arguments):
            zero_is_undefined = ir.Constant(ir.IntType(1), 1)
            count = _call(builder, f"llvm.{name}.i32", _WORD, (arguments[0], zero_is_undefined))
            return builder.zext(count, ir.IntType(64))

        return types.intp(types.uint32), generate

    function.__doc__ = doc
    return function


first_lane = _bit_count("cttz", "Return the number of the lowest lane of a non-empty mask.")
lanes_above_last = _bit_count("ctlz", "Return the number of lanes above the highest lane of a non-empty mask.")


@intrinsic
def hamming(typing_context, words, index, word):
    """Return the Hamming distances of 32 consecutive words of a contiguous array to one word.

    ``words`` is uint32 or uint64. The caller adds up the distances of codes of several words.
    """

    def generate(context, builder, signature, arguments):
        bits = signature.args[0].dtype.bitwidth
        kind = ir.VectorType(ir.IntType(bits), LANES)
        pointer = _address(context, builder, signature.args[0], arguments[0], arguments[1], kind)
        differing = builder.xor(builder.load(pointer, align=bits // 8), _splat(builder, arguments[2], kind))
        counts = _call(builder, f"llvm.ctpop.v{LANES}i{bits}", kind, (differing,))
        return builder.trunc(counts, _VECTOR)

    return vector_type(words, types.intp, words.dtype), generate
