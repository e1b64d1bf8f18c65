"""Ground of every test: checked shapes, strict JAX, one float width, where the data lies.

Loaded by each worker of a parallel run before any test module, so before `robins` is imported.
"""

import os

# Threads of the linear algebra wait by turning in circles, which costs more than they save. Set
# here, since NumPy reads it when it is imported; processes that tests start inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import ctypes
import gc
import signal
import sys
from pathlib import Path

import checking
import hypothesis
import jax
import jaxtyping
import meter
import pytest
import records
import tiers
from sketching import sketch

ROOT = Path(__file__).resolve().parents[1]

# Processes started by tests inherit these; a run on an accelerator is asked for by JAX_PLATFORMS.
# Most of a test run is compiling what runs for a moment: code is generated without LLVM's
# optimisation, by the older of XLA's emitters of loops, in one piece. That takes less than half of
# the time (XLA_FLAGS= tests what users run). What was compiled once serves every worker and the
# next run, however small: most programs are one operation on one shape. Where they are kept is not
# a cost. Nobody asks of compiled code which line of a test it is from, and to write that into it
# takes a tenth of the time.
SETTINGS = {
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_parallel_codegen_split_count=1",
    "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".pytest_cache" / "jax"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_TRACEBACK_IN_LOCATIONS_LIMIT": "0",
}
os.environ["MPLBACKEND"] = "Agg"  # figures never need a screen
os.environ.update({name: os.environ.get(name, value) for name, value in SETTINGS.items()})
# JAX was imported above: it has read its own already.
for name in (name for name in SETTINGS if name.startswith("JAX_")):
    was = getattr(jax.config, name.lower())
    jax.config.update(name.lower(), (str if was is None else type(was))(os.environ[name]))
# A shell starts what runs in the background deaf to interrupts, `nohup` to the end of a terminal;
# processes that tests start and interrupt would inherit that.
for number, handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# Every annotation in robins is checked at each call, shapes by jaxtyping, types by beartype: not in
# `make check`, where the checks would take longer to make than the tests to run.
if "robins" in sys.modules:
    raise pytest.UsageError("robins was imported before its annotations could be checked")
if not os.environ.get("UNCHECKED"):
    checking.install("robins")

# An accidental outer product or a silent change of width is an error here, not a slow surprise.
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# The first example pays for a compilation, so neither time nor slowness means anything.
hypothesis.settings.register_profile(
    "repeatable",
    derandomize=True,
    deadline=None,
    print_blob=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
# For `make certify`, and for hunting: `pytest --hypothesis-profile=explore`.
for profile, examples, repeatable in (("thousand", 1000, True), ("explore", 2000, False)):
    hypothesis.settings.register_profile(
        profile,
        hypothesis.settings.get_profile("repeatable"),
        derandomize=repeatable,
        max_examples=examples,
    )
hypothesis.settings.load_profile("repeatable")


# A program of JAX keeps 1.4 MiB of memory, however small, and Linux gives a process 65530 memory
# maps, of which a compiled run of a filter takes 400: a worker that keeps every program it compiled
# fills the memory or crashes in the compiler. It forgets them all when it has grown by this much
# since it last did; the cache gives back those needed again.
MANY_BYTES = 2**29
MAPS, SIZE = Path("/proc/self/maps"), Path("/proc/self/statm")
MANY_MAPS = 25_000
M_MMAP_THRESHOLD = -3  # of malloc.h
LOOK_EVERY = 10  # tests, at the maps: to write them out takes the system milliseconds
FINISHED = pytest.StashKey[int]()
LEFT = pytest.StashKey[int]()


def resident() -> int:
    """Bytes of memory of this process."""
    return int(SIZE.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def forget(config: pytest.Config) -> None:
    """Forget all compiled programs and what helpers of tests computed once."""
    jax.clear_caches()
    for name in ("memory", "scanned"):
        if module := sys.modules.get(f"robins.program.{name}"):
            module._known.clear()
    gc.collect()
    if MAPS.exists():
        ctypes.CDLL(None).malloc_trim(0)  # else what was freed stays with the process
        config.stash[LEFT] = resident()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item, nextitem):
    """Forget what a file computed once, after it, and compiled programs when there are many."""
    if nextitem is None or nextitem.module is not item.module:
        for kept in vars(item.module).values():
            # those of a helper are for several files
            if hasattr(kept, "cache_clear") and kept.__module__ == item.module.__name__:
                kept.cache_clear()
    if not MAPS.exists():
        return
    count = item.config.stash[FINISHED] = item.config.stash.get(FINISHED, 0) + 1
    large = resident() > item.config.stash[LEFT] + MANY_BYTES
    if large or (count % LOOK_EVERY == 0 and MAPS.read_bytes().count(b"\n") > MANY_MAPS):
        forget(item.config)


def pytest_configure(config):
    if MAPS.exists():
        # Else the allocator keeps ever larger arrays between those that live on.
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, 2**20)
    config.pluginmanager.register(meter.Meter(), "meter")
    if hasattr(config, "workerinput"):
        return
    config.pluginmanager.register(records.Records(config))
    if page := os.environ.get("CERTIFICATE"):
        config.pluginmanager.register(tiers.Certificate(page))


def pytest_collection_modifyitems(config, items):
    tiers.mark(items, not any("::" in arg for arg in config.args))
    first = tiers.first_files() if "CERTIFICATE" in os.environ else ()
    items[:], others = tiers.arrange(items, os.environ.get("PART", "1/1"), first)
    config.hook.pytest_deselected(items=others)


def pytest_collection_finish(session):
    """Freeze all imports: the collector of garbage need not look through them again.

    Tracing makes many objects that live on, so it is not to look after every 700 either.
    """
    forget(session.config)
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def outside(variable: str, folder: str) -> Path:
    """The folder a variable names, else ``../shared/<folder>``; skip the test if it is absent."""
    named = os.environ.get(variable)
    path = Path(named).resolve() if named else ROOT.parent / "shared" / folder
    if not path.is_dir():
        where = f"{variable}={named}" if named else f"{variable} is not set and ../shared/{folder}"
        pytest.skip(f"needs files that are not part of robins: {where} is not a folder")
    return path


@pytest.fixture(scope="session", autouse=True)
def own_configuration(tmp_path_factory):
    """Confirmations of user code are those of the tests, here and in processes that they start."""
    os.environ["XDG_CONFIG_HOME"] = str(tmp_path_factory.mktemp("config"))


@pytest.fixture
def sketched(monkeypatch):
    """Pictures of few dots."""
    sketch(monkeypatch)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Real logs: ROBINS_DATA, else ../shared/data beside the repository."""
    return outside("ROBINS_DATA", "data")


@pytest.fixture(scope="session")
def cases_dir() -> Path:
    """Reference numbers for filters: ROBINS_CASES, else ../shared/cases beside the repository."""
    return outside("ROBINS_CASES", "cases")


@pytest.fixture
def unchecked(monkeypatch):
    """As users run it: arguments are compared with annotations in the tests of each function.

    A traced program calls some of them a million times.
    """
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
