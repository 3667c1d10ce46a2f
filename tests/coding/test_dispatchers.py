"""Is numba's private side used with the releases that were tried, and with no others?"""

import json
import re
import tomllib
from pathlib import Path

import pytest
import yaml
from commands import environment, python, python_with

from terrainwave.coding.compiled import TRIED

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.large  # plain Python has no dispatchers

# Changes numba first; then says which compiler kernels have, what was told, and calls one.
CHOOSE = """
import json, sys, warnings
import numba, numba.core.registry
import numba.core.compiler, numba.core.typed_passes, numba.core.untyped_passes, numba.core.caching
exec(sys.argv[1])
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    from terrainwave.coding import compiled, jit
    from terrainwave.coding.quick import tripled
    assert tripled(4) == 12
own = type(tripled.made()) is numba.core.registry.CPUDispatcher
found = [compiled.COMPILER, own, "terrainwave.coding.compiler" in sys.modules]
print(json.dumps([found, [str(one.message) for one in told]]))
"""
QUICK = """
from terrainwave.coding.jit import kernel

@kernel
def tripled(number):
    return 3 * number
"""


@pytest.fixture(scope="module")
def chosen(tmp_path_factory):
    """A function that says what a new process chooses."""
    folder = tmp_path_factory.mktemp("chosen")
    # A kernel of its own, in the package: `make test` shares the cache of all others.
    (folder / "quick.py").write_text(QUICK)
    start = f"import terrainwave.coding\nterrainwave.coding.__path__.append({str(folder)!r})\n"

    def choose(change="", **settings):
        cache = {"NUMBA_CACHE_DIR": str(folder / "cache"), "TERRAINWAVE_NUMBA_CACHE": "1"}
        usual = {"NUMBA_DISABLE_JIT": "0", "TERRAINWAVE_COMPILER": "", **cache}
        done = python(start + CHOOSE, change, env=environment(**usual | settings))
        assert done.returncode == 0, done.stderr
        found, told = json.loads(done.stdout)
        return tuple(found), told

    return choose


FAST, PLAIN = ("fast", False, True), ("plain", True, False)


@pytest.mark.full
@pytest.mark.parametrize("version", ["0.64.1", "0.70.0rc1"])
def test_other_releases_newer_or_older_get_numbas_own_dispatcher_and_one_note(chosen, version):
    found, (note,) = chosen(f"numba.__version__ = {version!r}")
    assert found == PLAIN
    assert note.startswith(f"numba is {version}, and terrainwave was tried with numba 0.65 to ")


@pytest.mark.full
def test_a_variable_chooses_either_without_a_note(chosen):
    assert chosen(TERRAINWAVE_COMPILER="plain") == (PLAIN, [])
    other = "numba.__version__ = '0.99.0'"
    assert chosen(other, TERRAINWAVE_COMPILER="fast") == (FAST, [])
    assert chosen(other, TERRAINWAVE_COMPILER="plain") == (PLAIN, [])


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("change", "named"),
    [
        # A method that is overridden, of a class that has another name for it now.
        (
            "c = numba.core.untyped_passes.InlineInlinables\nc._do_it = c._do_work\ndel c._do_work",
            "InlineInlinables._do_work",
        ),
        # Another order of arguments.
        (
            "from numba.core import postproc\n"
            "postproc.PostProcessor.run = lambda self, extend_lifetimes=0, emit_dels=0: None",
            "PostProcessor.run(self, emit_dels, extend_lifetimes)",
        ),
        # An attribute of instances.
        (
            "from numba.core import inline_closurecall as i\n"
            "i.InlineWorker.__init__ = lambda self, **more: None\n"
            "i.InlineWorker.run_untyped_passes = lambda self, func, enable_ssa=False: None",
            "InlineWorker._compiler_pipeline",
        ),
        # What is imported.
        ("del numba.core.typed_passes.NopythonRewrites", "NopythonRewrites"),
        # What is called.
        (
            "from numba.core.codegen import CPUCodegen\ndel CPUCodegen._function_pass_manager",
            "_function_pass_manager",
        ),
    ],
    ids=["method", "arguments", "attribute", "import", "call"],
)
def test_a_private_name_that_has_moved_is_noticed_before_any_kernel_is_compiled(change, named):
    program = f"{change}\nfrom terrainwave.coding import compiled\nprint(compiled.COMPILER)"
    program = f"import numba.core.typed_passes, numba.core.registry\n{program}"
    done = python(program, env=environment(TERRAINWAVE_COMPILER=""))
    assert done.returncode == 0, done.stderr
    assert done.stdout == "plain\n"
    assert done.stderr.count("TerrainwaveWarning: numba is ") == 1
    assert named in done.stderr


@pytest.mark.full
def test_another_word_in_the_variable_is_refused_in_one_line(tmp_path):
    words = ["-m", "terrainwave", "warmup", "--for", "compress"]
    done = python_with(words, env=environment(TERRAINWAVE_COMPILER="quick"))
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "TERRAINWAVE_COMPILER: found quick, expected fast, plain or nothing" in line


def test_ci_runs_each_release_that_the_list_names():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text())
    assert tuple(workflow["jobs"]["numba"]["strategy"]["matrix"]["numba"]) == TRIED
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (lowest,) = (name for name in project["dependencies"] if name.startswith("numba"))
    assert lowest == f"numba>={TRIED[0]}"
    page = (ROOT / "docs" / "how-to" / "containers.md").read_text(encoding="utf-8")
    assert re.search(rf"\({TRIED[0]} to {TRIED[-1]}\)", page)
