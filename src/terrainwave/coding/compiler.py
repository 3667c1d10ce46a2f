"""Compiler of kernels.

Numba compiles a kernel to the end (optimised, turned into instructions, wrapped for Python, stored)
before it links it into a kernel that calls it, where all of this but the wrapper is repeated. Here
a kernel has two sides. Python calls numba's own; kernels call a `_Callee`, which is only typed and
lowered, and optimised within its caller: as fast, and two thirds of the time to compile.

The compiler is numba's, reassembled by its documented means (pipelines of passes, classes for
libraries) and some private attributes: `compiled` decides when it is used.
"""

import gc
import operator
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from numba.core import ir, ir_utils, postproc, transforms, types
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import Compiler, CompileResult, DefaultPassBuilder
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.inline_closurecall import InlineWorker
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering, NopythonRewrites
from numba.core.untyped_passes import InlineInlinables
from numba.cpython.builtins import do_minmax
from numba.extending import intrinsic

from terrainwave import interrupts
from terrainwave.coding.private_names import missing


class Kernel(CPUDispatcher):
    """Dispatcher for Python; kernels that call it use its `_Callee`."""

    def __init__(
        self,
        py_func: Callable[..., Any],
        locals: dict[str, Any] | None = None,
        targetoptions: dict[str, Any] | None = None,
        pipeline_class: type[Compiler] | None = None,
    ) -> None:
        super().__init__(py_func, locals, targetoptions, pipeline_class or _KernelCompiler)
        options = {**(targetoptions or {}), "no_cpython_wrapper": True}
        self._part = _Callee(py_func, locals, options, _CalleeCompiler)

    def compile(self, sig: Any) -> Any:
        """Compile for some types, or load the compiled code."""
        interrupts.check()
        with global_compiler_lock, _without_collector(), _with_shortcuts():
            entry = super().compile(sig)
            # Parts alone lack the objects that their code refers to.
            found = self.overloads.get(tuple(getattr(sig, "args", sig)))
            if found is not None and self._cache_misses:
                for environment in found._find_referenced_environments():
                    found.library.codegen.set_env(environment.env_name, environment)
            return entry

    def get_call_template(self, args: Any, kws: Any) -> Any:
        return self._part.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:
        """Return the `_Callee` of this kernel."""
        return self._part.get_overload(sig)

    @property
    def is_compiling(self) -> Any:
        """Return whether it is being compiled: its calls of itself then differ from others."""
        return self._compiling_counter or self._part._compiling_counter


class _Callee(CPUDispatcher):
    """A kernel as other kernels call it."""

    def compile(self, sig: Any) -> Any:
        args = tuple(sig)
        found = self.overloads.get(args)
        if found is None:
            interrupts.check()
            with self._compiling_counter:
                found = self.overloads[args] = self._compiler.compile(args, None)
        return found.entry_point


class _Inliner(InlineWorker):
    """Numba's worker for parts of kernels, without copying each of them twice to keep its IR."""

    def __init__(self, worker: InlineWorker) -> None:
        self.__dict__.update(worker.__dict__)
        self._compiler_pipeline = _untyped_passes

    def run_untyped_passes(self, func: Any, enable_ssa: bool = False) -> Any:
        """Return the IR of a part; nobody else has it, so a copy of a block may be itself."""
        found = super().run_untyped_passes(func, enable_ssa)
        for block in found.blocks.values():
            block.__deepcopy__ = lambda _memo, block=block: block
        return found


def _extreme_of(n: int, is_better: Callable[[Any, Any], Any]) -> Any:
    """Return code for `min` or `max` of two or three numbers, inlined into its caller.

    Numba compiles a function for each combination of types, some 30 ms each.
    """

    def of_all(typing_context: Any, *values: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return do_minmax(context, builder, signature.args, arguments, is_better)

        kind = typing_context.unify_types(*values)
        return None if kind is None else (kind(*values), generate)

    def of_two(typing_context: Any, first: Any, second: Any) -> Any:
        return of_all(typing_context, first, second)

    def of_three(typing_context: Any, first: Any, second: Any, third: Any) -> Any:
        return of_all(typing_context, first, second, third)

    return intrinsic(of_two if n == 2 else of_three)


_EXTREMES = {
    (function, n): _extreme_of(n, is_better)
    for function, is_better in ((min, operator.lt), (max, operator.gt))
    for n in (2, 3)
}


def _take_extremes_in_place(func_ir: Any) -> None:
    """Replace calls of `min` and `max`."""
    for block in func_ir.blocks.values():
        body: list[Any] = []
        for statement in block.body:
            call = getattr(statement, "value", None)
            if isinstance(call, ir.Expr) and call.op == "call" and not (call.kws or call.vararg):
                called = ir_utils.guard(ir_utils.get_definition, func_ir, call.func)
                function = called.value if isinstance(called, ir.Global) else None
                if function is min or function is max:
                    extreme = _EXTREMES.get((function, len(call.args)))
                    if extreme is not None:
                        place = ir.Var(block.scope, ir_utils.mk_unique_var("$extreme"), call.loc)
                        named = ir.Global(function.__name__, extreme, call.loc)
                        body.append(ir.Assign(named, place, call.loc))
                        func_ir._definitions[place.name] = [named]
                        call.func = place
            body.append(statement)
        block.body = body


@register_pass(mutates_CFG=True, analysis_only=False)
class _Inlining(InlineInlinables):
    """Pass that inlines parts of kernels, and `min` and `max`."""

    _name = "part_inlining"

    def run_pass(self, state: Any) -> bool:
        _take_extremes_in_place(state.func_ir)
        return bool(super().run_pass(state))

    def _do_work(self, *arguments: Any) -> Any:
        *others, worker = arguments
        return super()._do_work(*others, _Inliner(worker))


def _untyped_passes(state: Any) -> Any:
    """Return numba's passes before type inference, with our own among them."""
    return _replaced(DefaultPassBuilder.define_untyped_pipeline(state), _OF_KERNELS)


def _replaced(passes: Any, others: dict[type, type | None]) -> Any:
    """Replace or remove some passes of a pipeline, in place; return it."""
    found = [(others.get(one, one), text) for one, text in passes.passes]
    passes.passes = [(one, text) for one, text in found if one is not None]
    passes._finalized = False
    passes.finalize()
    return passes


class _KernelCompiler(Compiler):
    """Numba's compiler with a faster inliner."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's passes, with our own among them."""
        return [_replaced(passes, _OF_KERNELS) for passes in super().define_pipelines()]


class _CalleeCompiler(Compiler):
    """The same up to unoptimised code."""

    def define_pipelines(self) -> list[Any]:
        return [_replaced(passes, _OF_CALLEES) for passes in super().define_pipelines()]


@register_pass(mutates_CFG=True, analysis_only=False)
class _CalleeLowering(NativeLowering):
    """Pass that lowers into a `_CalleeLibrary`."""

    _name = "part_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower a function; register it under a placeholder object."""

        def entry(*_: Any) -> None:
            raise AssertionError("a part of kernels is never called from Python")

        state.library = _CalleeLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        lowered = state["cr"]
        state.targetctx.insert_user_function(entry, lowered.fndesc, [state.library])
        state["cr"] = lowered._replace(cfunc=entry)
        return True


class _CalleeLibrary(JITCodeLibrary):
    """Code that is linked into its callers before it is optimised."""

    def add_llvm_module(self, module: Any) -> None:
        """Add a module's functions, simplified; otherwise loops end up slower."""
        module.data_layout = self._codegen._data_layout
        passes, builder = self._codegen._function_pass_manager()
        for function in module.functions:
            if not function.is_declaration:
                passes.run(function, builder)
        self._final_module.link_in(module)

    def finalize(self) -> None:
        """Link the callees of these functions; the caller's library does the rest."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


# The omitted passes are for operations on whole arrays, which kernels don't use.
_OF_KERNELS: dict[type, type | None] = {InlineInlinables: _Inlining, NopythonRewrites: None}
_OF_CALLEES = {**_OF_KERNELS, NativeLowering: _CalleeLowering}


class _Shortcut(NamedTuple):
    """A method of numba's, and a faster equivalent for kernels."""

    owner: type
    name: str
    method: Callable[..., Any]
    original: Callable[..., Any]


_shortcuts: list[_Shortcut] = []


def _shortcut(owner: type, name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Replace a method by a function, which receives it, while kernels are compiled."""

    def taken(function: Callable[..., Any]) -> Callable[..., Any]:
        original = getattr(owner, name)

        def method(*arguments: Any, **options: Any) -> Any:
            return function(original, *arguments, **options)

        _shortcuts.append(_Shortcut(owner, name, method, original))
        return function

    return taken


@contextmanager
def _with_shortcuts() -> Iterator[None]:
    """Activate shortcuts; the caller must hold the compiler's lock, as they affect all of numba."""
    for shortcut in _shortcuts:
        setattr(shortcut.owner, shortcut.name, shortcut.method)
    try:
        yield
    finally:
        for shortcut in _shortcuts:
            setattr(shortcut.owner, shortcut.name, shortcut.original)


_OF_OPERATIONS = types.Number, types.Boolean, types.Array, types.BaseTuple
_known_operations: dict[Any, Any] = {}


@_shortcut(types.Function, "get_call_type")
def _typed_once(original: Any, function: Any, context: Any, args: Any, kws: Any) -> Any:
    """Return the signature of an operation on some types, found once.

    Numba tries each of a dozen templates, and again for each ``+`` of a kernel.
    """
    is_operation = getattr(function.typing_key, "__module__", None) == "_operator" and not kws
    if not (is_operation and all(isinstance(kind, _OF_OPERATIONS) for kind in args)):
        return original(function, context, args, kws)
    key = function, args
    if key not in _known_operations:
        _known_operations[key] = original(function, context, args, kws)
    return _known_operations[key]


@_shortcut(postproc.PostProcessor, "run")
def _processed(
    original: Any, processor: Any, emit_dels: bool = False, extend_lifetimes: bool = False
) -> None:
    """Process IR after a pass, without the live variables at the start of each block.

    Only generators and interpreted functions need these; numba computes them after most passes.
    """
    func_ir = processor.func_ir
    if func_ir.is_generator:
        original(processor, emit_dels, extend_lifetimes)
        return
    func_ir.blocks = transforms.canonicalize_cfg(func_ir.blocks)
    func_ir.variable_lifetime = postproc.VariableLifetime(func_ir.blocks)
    func_ir.generator_info = None
    if emit_dels:
        processor._insert_var_dels(extend_lifetimes=extend_lifetimes)


@contextmanager
def _without_collector() -> Iterator[None]:
    """Disable garbage collection: a compiler makes many objects that stay, and little garbage."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def missing_names() -> list[str]:
    """Return the names of numba's internals that this compiler needs and that are missing.

    An override of a method that numba has renamed would silently never be called.
    """
    return missing(
        {
            CPUDispatcher: (
                "__init__(self, py_func, locals, targetoptions, pipeline_class)",
                "compile(self, sig)",
                "get_call_template(self, args, kws)",
                "get_overload(self, sig)",
                *("is_compiling", "overloads", "_compiler", "_compiling_counter", "_cache_misses"),
            ),
            CompileResult: (
                "_find_referenced_environments(self)",
                "_replace",
                "entry_point",
                "fndesc",
            ),
            Compiler: ("define_pipelines(self)",),
            DefaultPassBuilder: ("define_untyped_pipeline(state, name)",),
            PassManager: ("passes", "_finalized", "finalize(self)"),
            InlineInlinables: (
                "run_pass(self, state)",
                "_do_work(self, state, work_list, block, i, expr, inline_worker)",
            ),
            InlineWorker: (
                "run_untyped_passes(self, func, enable_ssa)",
                "_compiler_pipeline",
            ),
            NativeLowering: ("run_pass(self, state)",),
            JITCodeLibrary: (
                "add_llvm_module(self, ll_module)",
                "finalize(self)",
                "_get_module_for_linking(self)",
                *("_codegen", "_final_module", "_finalized", "_linking_libraries", "_reload_init"),
            ),
            JITCPUCodegen: (
                "_function_pass_manager",
                "_data_layout",
                "set_env(self, env_name, env)",
            ),
            types.Function: ("get_call_type(self, context, args, kws)", "typing_key"),
            postproc.PostProcessor: (
                "run(self, emit_dels, extend_lifetimes)",
                *("func_ir", "_insert_var_dels(self, extend_lifetimes)"),
            ),
        }
    )
