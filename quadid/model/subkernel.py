"""Functions that only kernels call: handed to each kernel as they were written, optimised and made machine code there.

numba makes machine code of every compiled function and hands its optimised code on: a function that is called three
levels down is optimised and assembled four times.  Here that is done once, for the kernel that Python calls.
"""

# mypy: allow-untyped-calls

from __future__ import annotations

from typing import Any

from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, Flags
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering


class Subkernel(JITCodeLibrary):
    """Code of one function and of all it calls."""

    def finalize(self) -> None:
        """Links what the function calls; nothing else is done before a kernel takes it up."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


class Settled(Flags):
    """Flags of a function that do not change: numba looks them up, value by value, at every call it compiles."""

    known: dict[Flags, Settled] = {}

    def __init__(self, flags: Flags) -> None:
        super().__init__(flags)
        self._hash: int = super().__hash__()

    def __hash__(self) -> int:
        return self._hash

    def copy(self) -> Flags:
        """Itself, so that a look-up ends at the same object."""
        return self


class Remembering:
    """Looks up once what an operation makes of numbers and arrays under the same flags: a typing context of numba."""

    found: dict[tuple[Flags, Any, tuple[types.Type, ...]], Any] = {}

    def __init__(self, context: Any, flags: Flags) -> None:
        self._context, self._flags = context, flags

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def resolve_function_type(self, function: Any, args: Any, named: Any) -> Any:
        """Signature of a call, or None."""
        plain = not named and all(isinstance(kind, types.Number | types.Boolean | types.Array) for kind in args)
        if not plain or isinstance(function, types.Dispatcher):
            return self._context.resolve_function_type(function, args, named)
        key = self._flags, function, tuple(args)
        if key not in self.found:
            self.found[key] = self._context.resolve_function_type(function, args, named)
        return self.found[key]


@register_pass(mutates_CFG=True, analysis_only=False)
class SubkernelLowering(NativeLowering):
    """Writes the code of a piece, and none that Python could call."""

    _name = "piece_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lowers as numba does, into a library that is not made machine code."""
        state.library = Subkernel(state.targetctx.codegen(), state.func_id.func_qualname)
        super().run_pass(state)
        lowered = state["cr"]
        # numba distinguishes compiled functions by what Python would call, which has to be a builtin; this one raises.
        entry = f"{{{lowered.fndesc.qualname} is called by kernels only}}".format
        state["cr"] = lowered._replace(cfunc=entry)
        state.targetctx.insert_user_function(entry, lowered.fndesc, [state.library])
        return True


class SubkernelCompiler(CompilerBase):
    """`pipeline_class` of numba for pieces."""

    def __init__(self, typing: Any, target: Any, library: Any, args: Any, returns: Any, flags: Any, names: Any) -> None:
        flags.no_compile = True
        own = Settled(flags)
        settled = Settled.known.setdefault(own, own)
        super().__init__(Remembering(typing, settled), target, library, args, returns, settled, names)

    def define_pipelines(self) -> list[Any]:
        """Takes the passes of numba, but for the last."""
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)
        manager.passes = [(SubkernelLowering if p is NativeLowering else p, why) for p, why in manager.passes]
        manager.finalize()
        return [manager]
