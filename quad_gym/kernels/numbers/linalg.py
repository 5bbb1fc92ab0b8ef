"""Vectors and matrices with `+ - * @`, so that kernels read like equations.

A vector is a tuple of three or four numbers, a matrix a tuple of as many rows; both live in
registers. One operand may mix lanes and floats: `inverse_mass * force_I - (0.0, 0.0, p.gravity)`.

| expression                    | operands                                                    |
|-------------------------------|-------------------------------------------------------------|
| `a + b`, `a - b`, `-a`        | vectors or matrices                                         |
| `s * a`                       | a number and a vector or a matrix                           |
| `M @ a`, `M.T`, `outer(a, b)` | a matrix and a vector or a matrix; its transpose; `a b^T`   |

**A sum fuses the product on its right.** `a + s * b`, `a - s * b` and `M + outer(a, b)` are one
multiply-add for each number, if the product is computed in the branch in which it is added. The
product on the left of a sum is rounded first; `a + rounded(s * b)` rounds one on the right, too.

`load3`, `load4`, `load33` and `load44` read an array's first numbers as a vector or matrix, `store`
writes one into an array, and `keep` writes it in some lanes only.

With lanes these are ordinary tuples. The instance of a kernel for floats has a separate type, as
`+` concatenates tuples of floats: arithmetic returns it, and so do `vector` and all that loads from
arrays, so that a sum needs one operand that comes from these. Nothing is fused there.
"""

import itertools
import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_global, signature
from numba.extending import infer_getattr, intrinsic, lower_builtin, lower_getattr

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.numbers.lanes import (
    ASKED_FIRST,
    Floats,
    Lanes,
    add_numbers,
    fuse,
    is_product,
    lanes,
    select,
    vector_of,
    zero_like,
)
from quad_gym.records import SINGLE

# ---- types -----------------------------------------------------------------------------------

_LENGTHS = (3, 4)


def _shape(kind: Any) -> tuple[int, ...] | None:
    """The shape of a type as NumPy would have it, () for a number; None for any other type."""
    if kind == lanes or isinstance(kind, types.Float | types.Integer):
        return ()
    if isinstance(kind, types.BaseTuple) and len(kind) in _LENGTHS:
        shapes = {_shape(part) for part in kind}
        part = shapes.pop() if len(shapes) == 1 else None
        if part is not None and len(part) < 2:
            return (len(kind), *part)
    return None


def _contains(kind: Any, sought: type) -> bool:
    if isinstance(kind, types.BaseTuple) and any(_contains(part, sought) for part in kind):
        return True
    return isinstance(kind, sought)


def _number_of(*kinds: Any) -> Any:
    """The type of the numbers that result from an operation on these types."""
    return lanes if any(_contains(kind, Lanes) for kind in kinds) else types.float64


def _type(shape: tuple[int, ...], number: Any) -> Any:
    if not shape:
        return number
    return (types.UniTuple if number == lanes else Floats)(_type(shape[1:], number), shape[0])


# ---- values ----------------------------------------------------------------------------------


def _parts(builder: ir.IRBuilder, value: Any) -> list[Any]:
    """The parts of a vector or matrix, as the products that they are where it was just computed."""
    parts: dict[int, Any] = {}
    made = value
    while isinstance(made, ir.instructions.InsertValue) and len(made.indices) == 1:
        parts.setdefault(made.indices[0], made.operands[1])
        made = made.operands[0]
    count = value.type.count
    return [parts[i] if i in parts else builder.extract_value(value, i) for i in range(count)]


def _made_of(builder: ir.IRBuilder, parts: Any) -> Any:
    parts = list(parts)
    value = ir.Constant(ir.ArrayType(parts[0].type, len(parts)), ir.Undefined)
    for i, part in enumerate(parts):
        value = builder.insert_value(value, part, i)
    return value


def _each(builder: ir.IRBuilder, emit: Callable[..., Any], *values: Any) -> Any:
    """Apply `emit` to corresponding numbers of vectors or matrices."""
    if not isinstance(values[0].type, ir.ArrayType):
        return emit(builder, *values)
    parts = zip(*(_parts(builder, value) for value in values), strict=True)
    return _made_of(builder, [_each(builder, emit, *some) for some in parts])


def _is_fused(right: Any) -> bool:
    return isinstance(right.type, ir.VectorType) and is_product(right)


def _add(builder: ir.IRBuilder, left: Any, right: Any) -> Any:
    if _is_fused(right):
        return fuse(builder, *right.operands, left)
    return builder.fadd(left, right)


def _subtract(builder: ir.IRBuilder, left: Any, right: Any) -> Any:
    if _is_fused(right):
        factor, other = right.operands
        return fuse(builder, builder.fneg(factor), other, left)
    return builder.fsub(left, right)


def _multiply(builder: ir.IRBuilder, left: Any, right: Any) -> Any:
    if isinstance(left.type, ir.ArrayType):
        left, right = right, left
    return _each(builder, lambda builder, number: builder.fmul(left, number), right)


def _dot(builder: ir.IRBuilder, left: list[Any], right: list[Any]) -> Any:
    """The number left[0] * right[0] + left[1] * right[1] + ..."""
    add = add_numbers if isinstance(left[0].type, ir.VectorType) else ir.IRBuilder.fadd
    total, *others = (builder.fmul(a, b) for a, b in zip(left, right, strict=True))
    for product in others:
        total = add(builder, total, product)
    return total


def _transposed(builder: ir.IRBuilder, value: Any) -> Any:
    rows = [_parts(builder, row) for row in _parts(builder, value)]
    return _made_of(builder, [_made_of(builder, column) for column in zip(*rows, strict=True)])


def _matrix_product(builder: ir.IRBuilder, left: Any, right: Any) -> Any:
    if isinstance(right.type.element, ir.ArrayType):  # (A B)^T = B^T A^T, column by column
        columns = _parts(builder, _transposed(builder, right))
        products = [_matrix_product(builder, left, column) for column in columns]
        return _transposed(builder, _made_of(builder, products))
    numbers = _parts(builder, right)
    rows = [_parts(builder, row) for row in _parts(builder, left)]
    return _made_of(builder, [_dot(builder, row, numbers) for row in rows])


# ---- operators -------------------------------------------------------------------------------


def _operator(operation: Any, shape_of: Callable[..., Any], emit: Callable[..., Any]) -> None:
    """Define a function of `operator` by the shape and the value of its result.

    `shape_of` gets the operands' shapes, and returns None for undefined results.
    """

    @infer_global(operation)
    class _OperatorTyping(AbstractTemplate):
        metadata = ASKED_FIRST

        def generic(self, args, kws):  # type: ignore[no-untyped-def]
            shapes = [_shape(kind) for kind in args]
            shape = None if None in shapes else shape_of(*shapes)
            number = _number_of(*args)
            plain = number != lanes and not any(_contains(kind, Floats) for kind in args)
            if not shape or (plain and operation is operator.add):
                return None
            return signature(_type(shape, number), *(_type(each, number) for each in shapes))

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return emit(builder, *args)

    shapes = [(), *((n,) for n in _LENGTHS), *((n, n) for n in _LENGTHS)]
    unary = operation is operator.neg
    for given in itertools.product(shapes, repeat=1 if unary else 2):
        if shape_of(*given):
            for number in (lanes, types.float64):
                lower_builtin(operation, *(_type(shape, number) for shape in given))(lower)


def _number_by_number(emit: Callable[..., Any]) -> Callable[..., Any]:
    return lambda builder, *values: _each(builder, emit, *values)


def _of_sum(a: Any, b: Any) -> Any:
    return a if a == b else None


def _of_multiple(a: Any, b: Any) -> Any:
    return None if a and b else a or b


def _of_product(a: Any, b: Any) -> Any:
    return (a[0], *b[1:]) if len(a) == 2 and b and a[1] == b[0] else None


_operator(operator.add, _of_sum, _number_by_number(_add))
_operator(operator.sub, _of_sum, _number_by_number(_subtract))
_operator(operator.mul, _of_multiple, _multiply)
_operator(operator.matmul, _of_product, _matrix_product)
_operator(operator.neg, lambda a: a, _number_by_number(ir.IRBuilder.fneg))


@infer_getattr
class _MatrixAttributes(AttributeTemplate):
    key = types.BaseTuple

    def generic_resolve(self, kind: Any, name: str) -> Any:
        shape = _shape(kind)
        if name == "T" and shape is not None and len(shape) == 2:
            return _type(shape[::-1], _number_of(kind))
        return None


@lower_getattr(types.BaseTuple, "T")
def _transpose(context, builder, kind, value):  # type: ignore[no-untyped-def]
    square = _type(_shape(kind), _number_of(kind))  # type: ignore[arg-type]
    return _transposed(builder, context.cast(builder, value, kind, square))


# ---- functions -------------------------------------------------------------------------------


def vector(*numbers: Any) -> Any:
    """The vector of these numbers, for a sum in the instance for floats."""
    raise NotImplementedError("vector is available inside kernels only")


@infer_global(vector)
class _VectorTyping(AbstractTemplate):
    metadata = ASKED_FIRST

    def generic(self, args, kws):  # type: ignore[no-untyped-def]
        number = _number_of(*args)
        return signature(_type((len(args),), number), *(number for _ in args))


@lower_builtin(vector, types.VarArg(types.Any))
def _vector(context, builder, sig, args):  # type: ignore[no-untyped-def]
    return _made_of(builder, args)


@intrinsic
def outer(typing_context, a, b):  # type: ignore[no-untyped-def]
    """The matrix a b^T."""
    number = _number_of(a, b)
    a, b = _type(_shape(a), number), _type(_shape(b), number)

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        numbers = _parts(builder, args[0])
        return _made_of(builder, [_multiply(builder, number, args[1]) for number in numbers])

    return _type((len(a), len(b)), number)(a, b), lower


@intrinsic
def rounded(typing_context, value):  # type: ignore[no-untyped-def]
    """A vector or matrix as it is, with which no sum is fused."""

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        count = len(value)
        return _made_of(builder, [builder.extract_value(args[0], i) for i in range(count)])

    return value(value), lower


@intrinsic
def polynomial(typing_context, x, coefficients):  # type: ignore[no-untyped-def]
    """The number c0 + x (c1 + x (c2 + ...)), by Horner's rule."""
    number = _number_of(x)

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        add = ir.IRBuilder.fadd
        *others, value = (builder.extract_value(args[1], i) for i in range(len(coefficients)))
        if number == lanes:
            given = zip((value, *others), (coefficients[-1], *coefficients), strict=False)
            value, *others = (vector_of(context, builder, c, kind, lanes) for c, kind in given)
            add = _add
        for c in reversed(others):
            value = add(builder, c, builder.fmul(args[0], value))
        return value

    return number(number, coefficients), lower


# ---- arrays ----------------------------------------------------------------------------------


def _access(context: Any, builder: Any, kind: Any, place: tuple[int, ...]) -> tuple[Any, ...]:
    """Functions that read and write a number of an array, and the number's index."""
    index = types.UniTuple(types.uintp, len(place)) if len(place) > 1 else types.uintp
    read = context.get_function(operator.getitem, signature(kind.dtype, kind, index))
    types_of_write = (types.none, kind, index, kind.dtype)
    write = context.get_function(operator.setitem, signature(*types_of_write))
    numbers = [context.get_constant(types.uintp, i) for i in place]
    return read, write, _made_of(builder, numbers) if len(place) > 1 else numbers[0]


def _loader(*shape: int) -> Any:
    """Make a function that returns the first numbers of an array as a vector or matrix."""

    @intrinsic
    def load(typing_context, array):  # type: ignore[no-untyped-def]
        if not isinstance(array, types.Array):
            return None

        def part(context, builder, values, place):  # type: ignore[no-untyped-def]
            if len(place) < len(shape):
                count = range(shape[len(place)])
                return _made_of(
                    builder, [part(context, builder, values, (*place, i)) for i in count]
                )
            read, _, index = _access(context, builder, array, place)
            return read(builder, (values[0], index))

        def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
            return part(context, builder, args, ())

        return _type(shape, array.dtype)(array), lower

    return load


load3, load4, load33, load44 = _loader(3), _loader(4), _loader(3, 3), _loader(4, 4)


def _write(array: Any, value: Any, *mask: Any) -> Any:
    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        for place in itertools.product(*map(range, _shape(value))):  # type: ignore[arg-type]
            number, kind = args[-1], value
            for i in place:
                number, kind = builder.extract_value(number, i), kind.types[i]
            number = context.cast(builder, number, kind, array.dtype)
            read, write, index = _access(context, builder, array, place)
            if mask:
                number = builder.select(args[1], number, read(builder, (args[0], index)))
            write(builder, (args[0], index, number))
        return context.get_dummy_value()

    return types.none(array, *mask, value), lower


@intrinsic
def store(typing_context, array, value):  # type: ignore[no-untyped-def]
    """Write a vector or matrix into the first places of an array."""
    return _write(array, value)


@intrinsic
def keep(typing_context, array, mask, value):  # type: ignore[no-untyped-def]
    """Write a vector or matrix into the first places of an array where `mask` is set."""
    return _write(array, value, mask)


# --------------------------------------------------------------------------------------------------
# Products of vectors and matrices, which have operators.
# --------------------------------------------------------------------------------------------------


@kernel
def dot(a, b):
    """The number a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a, b):
    """The vector a x b."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    return vector(x, y, a[0] * b[1] - a[1] * b[0])


@kernel
def norm(a):
    """The length |a|."""
    return math.sqrt(dot(a, a))


_SHORTEST_SQUARE = 1e-30 if SINGLE else 1e-60
"""Square of the length of the shortest vector whose direction is known to all digits."""


@kernel
def unit_or(a, fallback):
    """The unit vector a / |a|, or `fallback` where a is too short to have a direction."""
    square = dot(a, a)
    usable = square > _SHORTEST_SQUARE
    return select(usable, 1.0 / math.sqrt(select(usable, square, 1.0)) * a, fallback)


@kernel
def diagonal(d):
    """The matrix diag(d)."""
    zero = zero_like(d[0])
    return ((d[0], zero, zero), (zero, d[1], zero), (zero, zero, d[2]))


@kernel
def add_diagonal(m, d):
    """The matrix M + diag(d)."""
    (a, b, c), (d_a, d_b, d_c) = m, d
    return ((a[0] + d_a, a[1], a[2]), (b[0], b[1] + d_b, b[2]), (c[0], c[1], c[2] + d_c))


@kernel
def add_to_diagonal(m, s):
    """The matrix M + s I."""
    return add_diagonal(m, (s, s, s))


# --------------------------------------------------------------------------------------------------
# Larger matrices: arrays of a record, handled in blocks of 3 x 3.
#
# The filter's states and measurements come in threes. Nine sums run in parallel, which hides the
# latency of the multiply-adds.
# --------------------------------------------------------------------------------------------------


@kernel
def load_row3(a, i, j):
    """Row i, columns j to j + 2."""
    return vector(a[i, j], a[i, j + 1], a[i, j + 2])


@kernel
def load_column3(a, i, j):
    """Rows i to i + 2 of column j."""
    return vector(a[i, j], a[i + 1, j], a[i + 2, j])


@kernel
def store_column3(a, i, j, v):
    """Write a vector into rows i to i + 2 of column j."""
    for k in range(3):
        a[i + k, j] = v[k]


@kernel
def load_block(a, i, j):
    """The 3 x 3 block of an array whose corner is at row i, column j."""
    return (load_row3(a, i, j), load_row3(a, i + 1, j), load_row3(a, i + 2, j))


@kernel
def load_symmetric(a, i):
    """The 3 x 3 block on the diagonal of a symmetric matrix, from its lower triangle."""
    xx, yx, yy = a[i, i], a[i + 1, i], a[i + 1, i + 1]
    zx, zy, zz = load_row3(a, i + 2, i)
    return ((xx, yx, zx), (yx, yy, zy), (zx, zy, zz))


@kernel
def keep_lower(a, i, mask, m):
    """Write the lower triangle of a 3 x 3 block on the diagonal, in the lanes `mask`."""
    for k in range(3):
        for j in range(k + 1):
            a[i + k, i + j] = select(mask, m[k][j], a[i + k, i + j])


@kernel
def keep_block(a, i, j, mask, m):
    """Write a 3 x 3 block, in the lanes `mask`."""
    for k in range(3):
        for n in range(3):
            a[i + k, j + n] = select(mask, m[k][n], a[i + k, j + n])


@kernel
def store_block(a, i, j, m):
    """Write a 3 x 3 block."""
    a[i, j], a[i, j + 1], a[i, j + 2] = m[0]
    a[i + 1, j], a[i + 1, j + 1], a[i + 1, j + 2] = m[1]
    a[i + 2, j], a[i + 2, j + 1], a[i + 2, j + 2] = m[2]


@kernel
def sum_of_outers(a, i, b, k, columns):
    """The sum over the first columns j of a[i : i + 3, j] b[k : k + 3, j]^T."""
    total = outer(load_column3(a, i, 0), load_column3(b, k, 0))
    for j in range(1, columns):
        total = total + outer(load_column3(a, i, j), load_column3(b, k, j))
    return total


@kernel
def sum_of_squares(a, i, columns):
    """The sum over the first columns j of a[i : i + 3, j] a[i : i + 3, j]^T, which is symmetric."""
    x, y, z = load_column3(a, i, 0)
    xx, yx, yy, zx, zy, zz = x * x, y * x, y * y, z * x, z * y, z * z
    for j in range(1, columns):
        x, y, z = load_column3(a, i, j)
        xx, yx, yy = xx + x * x, yx + y * x, yy + y * y
        zx, zy, zz = zx + z * x, zy + z * y, zz + z * z
    return ((xx, yx, zx), (yx, yy, zy), (zx, zy, zz))


@kernel
def sum_of_outers_of_rows(a, b, i, k, rows):
    """The sum over the first rows j of a[j, i : i + 3]^T b[j, k : k + 3]."""
    total = outer(load_row3(a, 0, i), load_row3(b, 0, k))
    for j in range(1, rows):
        total = total + outer(load_row3(a, j, i), load_row3(b, j, k))
    return total
