"""Garbage in each output of an exported folder, to see which of it the folder's own test finds.

And the primitives of what is exported.
"""

import re
import subprocess

import jax

SPOIL = """
#include <stdlib.h>
static int spoilt(int n, void *last)
{
    const char *told = getenv("SPOIL");
    if (told && atoi(told) == n && last) { *(unsigned char *)last ^= 0x40; }
    return told && atoi(told) == n;
}
"""
STRUCT = re.compile(r"typedef struct \{\n(.*?)\} (\w+);", re.DOTALL)
FIELD = re.compile(r"^    \w+ (\w+)(?:\[\d+\])*;", re.MULTILINE)
ENTRY = re.compile(r"^(?:int|void) (\w+)\([^;{]*\)\n\{\n", re.MULTILINE)


def structs(header):
    """Names of the fields of each struct of a header, by the name of the struct."""
    return {name: FIELD.findall(body) for body, name in STRUCT.findall(header)}


def spoil(folder, name):
    """Let environment variable SPOIL choose one output of the library, whose last byte is changed.

    Returns the entry point and the field of each, in the order of their numbers, which begin at 1.
    """
    fields = structs((folder / f"{name}.h").read_text())
    source, outputs = (folder / f"{name}.c").read_text(), []

    def spoilt(entry, text):
        of = [("state", f) for f in fields[f"{name}_state"]]
        of += [("result", f) for f in fields.get(f"{entry}_result", ())]
        lines = ""
        for struct, field in of:
            outputs.append((entry, f"{struct}.{field}"))
            last = f"(unsigned char *)(&{struct}->{field} + 1) - 1"
            lines += f"    (void)spoilt({len(outputs)}, {last});\n"
        body, _, end = text.rpartition("    return ")
        if not body:
            return text.replace("\n}\n", f"\n{lines}}}\n")
        outputs.append((entry, "the code"))
        return f"{body}{lines}    return spoilt({len(outputs)}, NULL) + {end}"

    entries = list(ENTRY.finditer(source))
    public = [m for m in entries if m[1].startswith(f"{name}_")]
    for m in reversed(public):
        end = source.index("\n}\n", m.end()) + 3
        source = source[: m.start()] + spoilt(m[1], source[m.start() : end]) + source[end:]
    include = f'#include "{name}.h"\n'
    (folder / f"{name}.c").write_text(source.replace(include, include + SPOIL, 1))
    return outputs


def found(folder, count, flags="-std=c99 -O0"):
    """Statuses of the test of a spoilt folder: as it is, and with each output spoilt."""
    run = (
        f"make -s test CFLAGS='{flags}' && "
        f"for n in $(seq 0 {count}); do SPOIL=$n ./test > said$n; echo $?; done"
    )
    done = subprocess.run(["sh", "-c", run], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [int(line) for line in done.stdout.split()]


def primitives(jaxpr):
    """Names of all primitives of a jaxpr, inner ones included."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for value in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns")):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from primitives(inner)
