"""Scalar maths with dedicated GPU instructions. The simulator, which lacks them, uses the plain formulas.

Two are slightly less accurate than the plain formula, and replace it in float32 only.
"""

from __future__ import annotations

import numpy as np
from numba import cuda, types

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.devices import SIMULATED
from glassplat.kernels.maths.blending import Scalar, build_exp2


def fused_maths() -> Scalar:
    """Builds a b + c, rounded once."""
    if SIMULATED:

        @inlined
        def rounded_twice(a, b, c):
            return a * b + c

        return rounded_twice

    @inlined
    def fused(a, b, c):
        return cuda.fma(a, b, c)

    return fused


def exp2_maths(real: type) -> Scalar:
    """Builds 2^t. In float32 within two units in the last place; 0 for results below the smallest normal number."""
    if SIMULATED or real is not np.float32:
        return build_exp2(real)
    return _instruction("ex2.approx.ftz.f32")


def reciprocal_maths(real: type) -> Scalar:
    """Builds 1 / x. In float32 within one unit in the last place, for x that are normal numbers."""
    one = real(1.0)
    if not SIMULATED and real is np.float32:
        return _instruction("rcp.approx.ftz.f32")

    @inlined
    def reciprocal(x):
        return one / x

    return reciprocal


def _instruction(name: str) -> Scalar:
    """A PTX instruction from float32 to float32."""
    # Unavailable in the simulator.
    from llvmlite import ir
    from numba.cuda.extending import intrinsic

    @intrinsic
    def run(typing_context, x):
        def lower(context, builder, signature, arguments):
            number = ir.FloatType()
            made = ir.InlineAsm(ir.FunctionType(number, [number]), f"{name} $0, $1;", "=f,f")
            return builder.call(made, arguments)

        return types.float32(types.float32), lower

    return run
