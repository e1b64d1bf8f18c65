"""Many runs of a step on a GPU, as a function of JAX: its arrays stay on the device.

    step = Kernel(trace_step(step, state, row))
    states, kept = step(states, rows)

The kernel is that of `robins.program.cuda`, compiled by NVRTC and launched on the stream of XLA as
a foreign function. That function is C++, compiled once on this machine; so a compiler of the host
is needed too.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable, Sequence
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from robins.program.cuda import BLOCK, sizes, stepped, to_cuda
from robins.program.native import CPP, build
from robins.program.nvrtc import compile_cuda
from robins.program.refusal import BuildError, ProgramError
from robins.program.trace import Leaf, Program

LAUNCH_FLAGS = ("-std=c++17", "-O1")


class Machine(NamedTuple):
    """Where kernels run.

    Attributes:
        platform: of JAX.
        driver: the library with the functions of the CUDA driver.
        compile: machine code of a text.
        flags: for the compiler of the launcher.
    """

    platform: str
    driver: str
    compile: Callable[[str], bytes]
    flags: tuple[str, ...] = ()


def gpu() -> Machine:
    """The first GPU that JAX has.

    Raises:
        BuildError: it has none.
    """
    try:
        device = jax.devices("cuda")[0]
    except RuntimeError:
        raise BuildError("JAX finds no GPU", "", "run this on the CPU") from None
    architecture = "sm_" + device.compute_capability.replace(".", "")
    return Machine("CUDA", "libcuda.so.1", lambda text: compile_cuda(text, architecture).code)


def launcher(flags: tuple[str, ...] = ()) -> Path:
    """The library that launches kernels, for the headers of the JAX that is installed.

    Raises:
        BuildError: there is no compiler of C++.
    """
    text = (files("robins.program") / "launch.cc").read_text("utf-8")
    told = (*LAUNCH_FLAGS, f"-I{jax.ffi.include_dir()}", f'-DJAX="{jax.__version__}"', *flags)
    return build(text, told, CPP)


@lru_cache
def _launcher(platform: str, flags: tuple[str, ...]) -> tuple[ctypes.CDLL, str]:
    """The library that launches kernels, and the name of its target of foreign functions."""
    library = ctypes.CDLL(str(launcher(flags)))
    target = f"robins_steps_{platform.lower()}"
    capsule = jax.ffi.pycapsule(library.robins_steps_target)
    jax.ffi.register_ffi_target(target, capsule, platform=platform)
    return library, target


class Kernel:
    """A step's program on many runs at once, over many steps."""

    def __init__(self, program: Program, machine: Machine | None = None, block: int = BLOCK):
        """Compile and load the kernel of a step ``step(state, ...) -> (state, kept)``.

        Args:
            program: of `trace` or `trace_step`.
            machine: where it runs; by default the first GPU.
            block: threads of a block.

        Raises:
            ProgramError: the program is not such a step.
            BuildError: there is no GPU, or a compiler is missing or refuses the text.
        """
        self.program, self.parts = program, stepped(program)
        machine = gpu() if machine is None else machine
        text = to_cuda(program, block)
        library, self._target = _launcher(machine.platform, machine.flags)
        told = "\0".join([text, machine.platform, machine.driver])
        self._name = hashlib.sha256(told.encode()).hexdigest()
        code = machine.compile(text)
        said = library.robins_load(machine.driver.encode(), self._name.encode(), code, block)
        if said:
            raise BuildError(
                f"the driver does not load the kernel (CUresult {said})", machine.driver
            )
        self._run = jax.jit(self._steps, static_argnums=0)

    def __call__(self, state: Any, *rows: Any, every: int = 1) -> tuple[Any, Any]:
        """Step all runs.

        Args:
            state: as the step takes it, each array with an axis of runs before its own.
            rows: what the step takes beside it, each array with axes of steps and runs before its
                own; an axis of one run serves all.
            every: keep what each step of this number gives; 0 keeps nothing.

        Returns:
            The state in the end, and what was kept, with axes of kept steps and runs.

        Raises:
            ProgramError: the arrays are not of the structure or the shapes that were traced.
        """
        if jax.tree.structure((state, *rows)) != self.program.structure[0]:
            raise ProgramError(
                "arguments of another structure than was traced",
                fix="trace the step with a state and a row like these",
            )
        if not self.parts.rows:
            raise ProgramError(
                "the step takes nothing beside its state, so how many steps are meant is not known",
                fix="trace a step that takes a row, such as the time",
            )
        runs = _axes(state, self.parts.state, 1)[0]
        lead = _axes(rows, self.parts.rows, 2)
        steps, width = max(lead[0]), max(lead[1])
        if len(runs) > 1 or len(lead[0]) > 1 or lead[1] - {1, max(runs)}:
            raise ProgramError(
                f"runs {sorted(runs)} in the state, steps {sorted(lead[0])} and runs "
                f"{sorted(lead[1])} in the rows",
                fix="give all arrays the same numbers of steps and runs, or rows of one run",
            )
        self._check_zeros(state)
        return self._run((max(runs), steps, every, width), state, *rows)

    def _check_zeros(self, state: Any) -> None:
        leaves = jax.tree.leaves(state)
        for k, mask in self.program.zeros.items():
            if k < len(leaves) and mask.any() and not isinstance(leaves[k], Tracer):
                at = np.flatnonzero(mask.ravel())
                if jnp.any(jnp.asarray(leaves[k]).reshape(len(leaves[k]), -1)[:, at]):
                    raise ProgramError(
                        "a number is not zero that is zero in all states that follow from the "
                        "first",
                        self.parts.state[k].path,
                        "trace the step with a state like these, or use `trace`",
                    )

    def _steps(self, numbers: tuple[int, int, int, int], state: Any, *rows: Any) -> Any:
        runs, steps, every, width = numbers
        parts = self.parts
        lines = steps // every if every else 0
        before = _packed(state, parts.state, (runs,))
        given = _packed(rows, parts.rows, (steps, width))
        kinds = (jnp.float64, jnp.int64)
        shapes = [(n, runs) for n in sizes(parts.state)]
        shapes += [(lines, n, runs) for n in sizes(parts.kept)]
        call = jax.ffi.ffi_call(
            self._target,
            [jax.ShapeDtypeStruct(s, t) for s, t in zip(shapes, kinds * 2, strict=True)],
            input_output_aliases={0: 0, 1: 1},
        )
        names = ("runs", "steps", "every", "width")
        told = {name: np.int64(n) for name, n in zip(names, numbers, strict=True)}
        made = call(*before, *given, kernel=self._name, **told)
        leaves = [*_unpacked(made[:2], parts.state), *_unpacked(made[2:], parts.kept)]
        return jax.tree.unflatten(self.program.structure[1], leaves)


def _axes(tree: Any, leaves: list[Leaf], count: int) -> list[set[int]]:
    """The sizes that arrays have on some axes before their own."""
    shapes = [np.shape(x) for x in jax.tree.leaves(tree)]
    for shape, leaf in zip(shapes, leaves, strict=True):
        if shape[count:] != leaf.shape or len(shape) != len(leaf.shape) + count:
            raise ProgramError(
                f"{shape} was given where {leaf.shape} was traced, with {count} axes before it",
                leaf.path,
            )
    return [set(sizes) for sizes in zip(*(shape[:count] for shape in shapes), strict=True)]


def _packed(tree: Any, leaves: list[Leaf], lead: tuple[int, ...]) -> list[Array]:
    """Reals, and all other numbers, of arrays (*lead, ...): (*lead[:-1], numbers, runs)."""
    parts: tuple[list[Array], list[Array]] = ([jnp.zeros((*lead, 0))], [])
    parts[1].append(jnp.zeros((*lead, 0), jnp.int64))
    for value, leaf in zip(jax.tree.leaves(tree), leaves, strict=True):
        pool = int(leaf.kind != "real")
        flat = jnp.asarray(value).reshape(*np.shape(value)[: len(lead)], -1)
        parts[pool].append(
            jnp.broadcast_to(flat.astype(parts[pool][0].dtype), (*lead, flat.shape[-1]))
        )
    return [jnp.swapaxes(jnp.concatenate(part, axis=-1), -1, -2) for part in parts]


def _unpacked(arrays: Sequence[Array], leaves: list[Leaf]) -> list[Array]:
    """The arrays (*lead, ...) that reals and other numbers (*lead[:-1], numbers, runs) are."""
    at, made = [0, 0], []
    for leaf in leaves:
        pool, size = int(leaf.kind != "real"), int(np.prod(leaf.shape))
        flat = jnp.swapaxes(arrays[pool][..., at[pool] : at[pool] + size, :], -1, -2)
        at[pool] += size
        made.append(flat.reshape(*flat.shape[:-1], *leaf.shape).astype(leaf.dtype))
    return made
