"""Arrays in kernels that take any number of tensors: by their addresses, of which a table has as many rows as it needs.

An argument for each would be a kernel for each number of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array


def array_at(real: type) -> Callable[..., Any]:
    """The function that makes an array of type `real` of the `count` elements from `first` on behind an address.

    Nothing keeps what lies there: the caller holds the tensors until the kernel has returned.
    """
    kind = types.Array(types.float64 if real is np.float64 else types.float32, 1, "C")

    @intrinsic
    def at(typing, address, first, count):
        def generate(context, builder, sig, arguments):
            array = context.make_array(kind)(context, builder)
            size = context.get_constant(types.intp, kind.dtype.bitwidth // 8)
            begin = builder.inttoptr(arguments[0], context.get_data_type(kind.dtype).as_pointer())
            data = builder.gep(begin, [arguments[1]])
            populate_array(array, data=data, shape=[arguments[2]], strides=[size], itemsize=size, meminfo=None)
            return array._getvalue()

        if all(isinstance(argument, types.Integer) for argument in (address, first, count)):
            return kind(types.int64, types.intp, types.intp), generate

    return at
