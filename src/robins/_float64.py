"""Turn on 64-bit floats before any numeric module builds an array.

Navigation states lose metres in a few tens of steps in single precision, so float64 is mandatory.
Importing this module switches JAX over, or, if it is not imported yet, has it begin so; `require`
raises an error if it was switched back.
"""

import os
import sys

if "jax" in sys.modules:
    import jax

    jax.config.update("jax_enable_x64", True)
else:
    os.environ["JAX_ENABLE_X64"] = "1"  # read when JAX is imported


def require() -> None:
    """Raise if JAX would compute in single precision.

    Raises:
        RuntimeError: 64-bit floats were disabled after robins was imported.
    """
    import jax

    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "robins computes in 64-bit floats, but JAX is set to 32-bit: remove "
            "`jax_enable_x64 = False` or the environment variable JAX_ENABLE_X64=0."
        )
