"""Computation of sixteen squared distances at a time with vector instructions.

If sixteen running sums are stored in an array that might overlap the inputs, a compiler cannot keep them in registers.
So the loop over the dimensions is written as LLVM vector instructions, which the compiler adapts to the vector width of
the processor. The terms of a sum are always added in the same order, without fused multiply-add, so that equal inputs
give equal bits on every machine.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

LANES = 16

_SIXTEEN = ir.VectorType(ir.FloatType(), LANES)
_ZEROS = ir.Constant(_SIXTEEN, [0.0] * LANES)
_UNDEFINED = ir.Constant(_SIXTEEN, ir.Undefined)
_FIRST_LANE = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)

# Even and odd dimensions are summed separately, so that the processor can do two additions at the same time.
DIMENSIONS_PER_STEP = 2

Values = list[ir.Value]
Gap = Callable[[ir.IRBuilder, Values, ir.Value], ir.Value]


def _spread(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    first = builder.insert_element(_UNDEFINED, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, _UNDEFINED, _FIRST_LANE)


def _larger(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def _from_row(builder: ir.IRBuilder, row: Values, query: ir.Value) -> ir.Value:
    return builder.fsub(row[0], query)


def _from_box(builder: ir.IRBuilder, sides: Values, query: ir.Value) -> ir.Value:
    low, high = sides
    outside = _larger(builder, builder.fsub(low, query), builder.fsub(query, high))
    return _larger(builder, outside, _ZEROS)


def _summed(gap: Gap, operands: int) -> Any:
    """Make a compiled function that sums weight · gap² over dimensions, for sixteen rows or boxes at once.

    `gap` generates the instructions for one dimension that compute the gap between a query and sixteen rows or boxes.
    `operands` is the number of vectors stored per dimension: 1 for rows, 2 for the low and high sides of boxes.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Values) -> ir.Value:
        blocks, query, weights, sums = (
            context.make_array(kind)(context, builder, array)
            for kind, array in zip(signature.args[:4], arguments[:4], strict=True)
        )
        number, limit = arguments[4:]
        dimensions = builder.extract_value(query.shape, 0)
        first = builder.mul(number, builder.mul(dimensions, ir.Constant(number.type, operands)))
        vectors = builder.gep(builder.bitcast(blocks.data, _SIXTEEN.as_pointer()), [first])
        running = [cgutils.alloca_once_value(builder, _ZEROS) for _ in range(DIMENSIONS_PER_STEP)]

        def at(base: ir.Value, scale: int, offset: int) -> ir.Value:
            size = base.type
            return builder.add(builder.mul(base, ir.Constant(size, scale)), ir.Constant(size, offset))

        steps = builder.udiv(dimensions, ir.Constant(dimensions.type, DIMENSIONS_PER_STEP))
        with cgutils.for_range(builder, steps) as loop:
            for k, total in enumerate(running):
                d = at(loop.index, DIMENSIONS_PER_STEP, k)
                values = [builder.load(builder.gep(vectors, [at(d, operands, o)]), align=4) for o in range(operands)]
                distance = gap(builder, values, _spread(builder, builder.load(builder.gep(query.data, [d]))))
                weight = _spread(builder, builder.load(builder.gep(weights.data, [d])))
                term = builder.fmul(builder.fmul(distance, distance), weight)
                builder.store(builder.fadd(builder.load(total), term), total)

        result = builder.fadd(*(builder.load(total) for total in running))
        builder.store(result, builder.bitcast(sums.data, _SIXTEEN.as_pointer()), align=4)
        within = builder.fcmp_ordered("<=", result, _spread(builder, limit))
        return builder.zext(builder.bitcast(within, ir.IntType(LANES)), ir.IntType(64))

    def typed(_context: Any, blocks: Any, query: Any, weights: Any, sums: Any, _number: Any, limit: Any) -> Any:
        arrays = (blocks, query, weights, sums)
        if limit != types.float32 or any(a.dtype != types.float32 or a.layout != "C" for a in arrays):
            return None
        return types.int64(*arrays, types.int64, limit), generate

    return intrinsic(typed)


row_costs = _summed(_from_row, 1)
"""row_costs(blocks (B, D, 16), query (D,), weights (D,), sums (16,), number, limit): squared distances of 16 rows.

All arrays are float32, and D is even. Fills `sums` with the distances of the rows of block `number`. Bit l of the
returned integer is set if sums[l] <= limit.
"""

box_costs = _summed(_from_box, 2)
"""box_costs(boxes (G, D, 2, 16), query (D,), weights (D,), sums (16,), number, limit): squared distances of 16 boxes.

All arrays are float32, and D is even. A box is given by its low and high sides, and its distance is that of its point
nearest to the query. Fills `sums` with the distances of the boxes of group `number`. Bit l of the returned integer is
set if sums[l] <= limit.
"""
