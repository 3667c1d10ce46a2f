"""Shortcuts of numba's compiler, for the releases that `compiled.TRIED` names."""

from typing import Any

from numba import types
from numba.core import postproc, transforms
from numba.core.inline_closurecall import InlineWorker

_typed_anew = types.Function.get_call_type
_with_copies = InlineWorker.run_untyped_passes
_in_full = postproc.PostProcessor.run
_typed: dict[Any, Any] = {}
_OF_OPERATIONS = types.Number, types.Boolean, types.Array, types.BaseTuple


def _typed_once(function: Any, context: Any, args: Any, kws: Any) -> Any:
    """Return the signature of an operation on some types, found once.

    Numba tries each of a dozen templates, and again for each ``+`` of a kernel.
    """
    is_operation = getattr(function.typing_key, "__module__", None) == "_operator" and not kws
    if not (is_operation and all(isinstance(kind, _OF_OPERATIONS) for kind in args)):
        return _typed_anew(function, context, args, kws)
    key = function, args
    if key not in _typed:
        _typed[key] = _typed_anew(function, context, args, kws)
    return _typed[key]


def _without_copies(worker: Any, func: Any, enable_ssa: bool = False) -> Any:
    """Return the IR of a part; nobody else has it, so a copy of a block may be itself."""
    found = _with_copies(worker, func, enable_ssa)
    for block in found.blocks.values():
        block.__deepcopy__ = lambda _memo, block=block: block
    return found


def _processed(processor: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """Process IR after a pass, without the live variables at the start of each block.

    Only generators and interpreted functions need these; numba computes them after most passes.
    """
    func_ir = processor.func_ir
    if func_ir.is_generator:
        _in_full(processor, emit_dels, extend_lifetimes)
        return
    func_ir.blocks = transforms.canonicalize_cfg(func_ir.blocks)
    func_ir.variable_lifetime = postproc.VariableLifetime(func_ir.blocks)
    func_ir.generator_info = None
    if emit_dels:
        processor._insert_var_dels(extend_lifetimes=extend_lifetimes)


SHORTCUTS: tuple[tuple[Any, str, Any], ...] = (
    (types.Function, "get_call_type", _typed_once),
    (InlineWorker, "run_untyped_passes", _without_copies),
    (postproc.PostProcessor, "run", _processed),
)
