"""Arrays without reference counting, for kernels.

Numba counts a reference to an array wherever one is passed on, taken from a tuple or sliced, and
omits pairs that cancel; around loops it cannot. Each count is an atomic addition, together a
seventh of the time of encoding in `predictive.passes.code_pass`. A kernel's arguments live as long
as the call, so it need not count.
"""

from typing import Any, TypeVar

from terrainwave.coding.jit import Later

Borrowed = TypeVar("Borrowed")


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Return LLVM code for a value whose arrays have no owner to count references of."""
    from numba import types
    from numba.core import cgutils

    if isinstance(kind, types.Array):
        for name in ("meminfo", "parent"):
            k = context.data_model_manager[kind].get_field_position(name)
            nobody = cgutils.get_null_value(value.type.elements[k])
            value = builder.insert_value(value, nobody, k)
    if isinstance(kind, types.BaseTuple):
        inner: Any
        for k, inner in enumerate(kind):  # type: ignore[arg-type]
            part = _without_owner(context, builder, inner, builder.extract_value(value, k))
            value = builder.insert_value(value, part, k)
    return value


def _borrowed(_typing_context: Any, value: Any) -> Any:
    """Return an argument of a kernel, its arrays or those of a tuple without their owner.

    Only for use within the kernel: it must not return or keep anything derived from this.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _without_owner(context, builder, signature.args[0], arguments[0])

    return value(value), generate


def _made(same: Any) -> Any:
    from numba.core import config
    from numba.extending import intrinsic

    return same if config.DISABLE_JIT else intrinsic(_borrowed)


def _same(value: Borrowed) -> Borrowed:
    return value


borrowed: Any = Later(_same, _made)
