"""What each install brings: nothing undeclared, nothing unused, and without PyTorch and CUDA what needs neither."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import metadata, version
from pathlib import Path

import pytest
import yaml
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests.factory.installs import PROJECT, REPOSITORY, SMALL, closure, declared, pins, unpinned

OURS = {"tasks", "factory", "planners"}
DISTRIBUTIONS = {  # of modules whose distribution has another name
    "cv2": "opencv-python-headless",
    "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
    "google": "protobuf",
    "grpc": "grpcio",
    "hydra": "hydra-core",
    "mcap_protobuf": "mcap-protobuf-support",
    "yaml": "pyyaml",
}
UNSEEN = {  # declared without an import statement of ours
    "packaging": "torch.utils.cpp_extension imports it when gsplat compiles",
    "tensorboard": "torch.utils.tensorboard imports it",
}
RAY_ONLY = {"factory/graph/on_ray/graph.py"}  # loaded by executor=ray alone
GPU_ONLY = {  # by render.backend=gsplat alone
    "tasks/render/fit/on_torch.py",
    "tasks/render/scene/on_device.py",
    "tasks/render/splatting/tensors.py",
}
WHERE_IT_IS = {"torchvision": {"tasks/render/scene/on_device.py"}}  # used where a user has it, in no extra
GPU = re.compile(r"torch|triton|nvidia|cuda|cudnn|nccl|gsplat")


def imports(package: str, at_import: bool = False) -> dict[str, set[str]]:
    """Distribution -> files of the package that import it; at_import: as they are loaded, not within functions."""
    found: dict[str, set[str]] = {}
    for path in sorted((REPOSITORY / package).rglob("*.py")):
        for module in _modules(ast.parse(path.read_text()), at_import):
            word = module.partition(".")[0]
            if word not in sys.stdlib_module_names | OURS:
                name = canonicalize_name(DISTRIBUTIONS.get(word, word))
                found.setdefault(name, set()).add(path.relative_to(REPOSITORY).as_posix())
    return found


def _modules(node: ast.AST, at_import: bool) -> Iterator[str]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        if at_import and isinstance(child, ast.FunctionDef):
            continue
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.level == 0 and child.module:
            yield child.module
        else:
            yield from _modules(child, at_import)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "extras"),
    [
        ("tasks", ("run", "gpu")),
        ("factory", ("run", "gpu", "navsim", "py123d", "alpasim")),
        ("planners", ("planners", "alpasim")),
    ],
)
def test_every_import_is_declared_where_it_belongs(package: str, extras: tuple[str, ...]) -> None:
    allowed = set().union(*map(declared, extras))
    undeclared = {
        name: files
        for name, files in imports(package).items()
        if name not in allowed and files != WHERE_IT_IS.get(name)
    }
    assert not undeclared


@pytest.mark.parametrize("package", ["tasks", "factory"])
def test_what_the_small_install_lacks_is_imported_within_functions(package: str) -> None:
    lacking = {
        name: rest
        for name, files in imports(package, at_import=True).items()
        if name not in declared(SMALL) and (rest := files - RAY_ONLY - GPU_ONLY)
    }
    assert not lacking


@pytest.mark.slow
def test_every_declared_package_is_imported() -> None:
    imported = {name for package in OURS for name in imports(package)}
    extras = [extra for extra in PROJECT["optional-dependencies"] if extra not in ("dev", "docs")]
    unused = set().union(*map(declared, extras)) - imported - set(UNSEEN)
    assert not unused


LOCKS = {lock: pins(lock) for lock in ("run", "planners", "dev", "torch_cpu", "build", "tools")}


def test_every_pin_is_one_version_with_its_hashes_and_the_same_in_every_lock_file() -> None:
    files = [*(REPOSITORY / "locks").iterdir()]
    assert {file.stem for file in files} == set(LOCKS)
    assert not [line for file in files for line in re.findall(r"^\S.*[^\\]$", file.read_text(), re.M)], (
        "no hash follows"
    )
    versions: dict[str, set[str]] = {}
    for lock, found in LOCKS.items():
        for name, (pin, n_hashes) in found.items():
            assert re.fullmatch(r"==[\w.+]+", str(pin.specifier)) and n_hashes, f"{lock}: {pin}"
            if lock != "tools":
                versions.setdefault(name, set()).add(str(pin.specifier).removesuffix("+cpu"))
    assert not {name: told for name, told in versions.items() if len(told) > 1}


@pytest.mark.parametrize(
    ("extra", "lock", "lacks"),
    [("run", "run", ""), ("planners", "planners", ""), ("gpu", "planners", ""), ("dev", "dev", "torch>=2.6")],
)
def test_the_lock_files_pin_what_pyproject_asks_for(extra: str, lock: str, lacks: str) -> None:
    assert unpinned(extra, lock) == lacks.split(), "make locks"


@pytest.mark.parametrize("extra", ["run", "dev"])
def test_nothing_is_installed_that_no_lock_file_pins(extra: str) -> None:
    """What pip installs with --no-deps is what it would without."""
    pinned = set(LOCKS[extra]) | (set(LOCKS["torch_cpu"]) if extra == "dev" else set())
    assert closure(extra) - pinned == set()
    installed = {name: f"=={version(name)}" for name in closure(extra) & set(LOCKS[extra])}
    assert installed == {name: str(LOCKS[extra][name][0].specifier) for name in installed}, "make install"


def test_what_builds_the_project_is_pinned() -> None:
    groups = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    assert groups["dependency-groups"]["build"] == ["pip", *groups["build-system"]["requires"]]
    assert set(LOCKS["build"]) == {"pip", "setuptools"}
    named = {canonicalize_name(word) for word in groups["dependency-groups"]["tools"] if isinstance(word, str)}
    assert named < set(LOCKS["tools"])


# Permissive ones, and MPL-2.0, whose condition ends at its own files. How packages call them differs.
LICENCES = {
    *("0BSD", "Apache", "Apache 2.0", "Apache License", "Apache Software License", "Apache-2.0"),
    *("Apache-2.0 WITH LLVM-exception", "BSD", "BSD License", "3-Clause BSD License", "BSD-2-Clause", "BSD-3-Clause"),
    *("BSL-1.0", "CC0-1.0", "CNRI-Python", "ISC", "MIT", "MIT License", "MIT-0", "MIT-CMU", "MPL-2.0"),
    *("Mozilla Public License 2.0 (MPL 2.0)", "PSF-2.0", "Python Software Foundation License", "Zlib"),
}


def licences_of(name: str) -> set[str]:
    told = metadata(name)
    kept = [line.rpartition(" :: ")[2] for line in told.get_all("Classifier", []) if line.startswith("License :: OSI")]
    words = told.get("License-Expression") or " AND ".join(kept) or told.get("License", "")
    return set(re.split(r" AND | OR ", words))


def test_all_that_is_installed_has_a_licence_that_lets_the_factory_be_handed_on() -> None:
    refused = {name: unknown for name in sorted(closure("dev")) if (unknown := licences_of(name) - LICENCES)}
    assert not refused


def test_a_run_brings_neither_pytorch_nor_cuda() -> None:
    brought = closure("run")
    assert {"ray", "hydra-core", "numba"} <= brought, "the closure is worked out"
    assert not [name for name in brought if GPU.search(name)]


def test_the_small_install_has_neither_ray_nor_hydra() -> None:
    small = closure(SMALL)
    assert len(small) < 40 and not small & {"ray", "hydra-core", "omegaconf", "pydantic"}


def test_the_version_stands_in_one_place() -> None:
    import factory
    import planners
    import tasks

    assert factory.__version__ == planners.__version__ == tasks.__version__
    sections = re.findall(r"^## (\S+)", (REPOSITORY / "CHANGELOG.md").read_text(), re.M)
    version = Version(tasks.__version__)
    newest = next(Version(section) for section in sections if section != "Unreleased")
    assert (sections[0] == "Unreleased" and version > newest) if version.is_devrelease else version == newest
    cited = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert f"\n## {cited['version']} - {cited['date-released']}\n" in (REPOSITORY / "CHANGELOG.md").read_text()
    assert Version(cited["version"]) == newest
    shown = subprocess.run([sys.executable, "-m", "factory", "--version"], cwd=REPOSITORY, capture_output=True)
    assert shown.stdout.decode() == f"driving-data-factory {tasks.__version__}\n"


def test_make_installs_pytorch_for_the_cpu() -> None:
    command = ["make", "-n", "-B", "install"]
    made = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout
    assert re.search(r"--extra-index-url https://download\.pytorch\.org/whl/cpu -r locks/torch_cpu.lock ", made)
    (torch,) = LOCKS["torch_cpu"].values()
    assert str(torch[0].specifier) == f"{LOCKS['planners']['torch'][0].specifier}+cpu", "the label of the CPU's build"


OLD = "import sys; sys.version_info = (3, 9, 18, 'final', 0)\n"
WITHOUT = "import sys; sys.modules['ensurepip'] = None\n"  # as Debian's python3 without python3-venv


def python_that(tmp_path: Path, before: str) -> str:
    """A Python that runs this before what it is given by -c."""
    script = tmp_path / "python"
    script.write_text(
        f'#!/bin/sh\n[ "$1" = -c ] || exec {sys.executable} "$@"\nexec {sys.executable} -c "{before}$2"\n'
    )
    script.chmod(0o755)
    return str(script)


def make(tmp_path: Path, python: str, *words: str) -> tuple[Path, "subprocess.CompletedProcess[str]"]:
    """The Makefile in a folder with what its install reads, without a package index."""
    folder = tmp_path / "checkout"
    folder.mkdir(exist_ok=True)
    for name in ("Makefile", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, folder)
    shutil.copytree(REPOSITORY / "locks", folder / "locks", dirs_exist_ok=True)
    outer = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}  # `make test`
    env = outer | {"PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": os.devnull}
    words = ("make", *words, f"PYTHON={python}")
    return folder, subprocess.run(words, cwd=folder, env=env, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("before", "said"),
    [
        (OLD, "is Python 3.9.18, Python 3.11 or later is needed; give another: make demo PYTHON=python3.11"),
        (WITHOUT, "makes no .venv (import of ensurepip halted; None in sys.modules)"),
        (None, "no nowhere/python: give another by PYTHON=python3.11"),
    ],
    ids=["old", "without what makes a .venv", "not there"],
)
def test_a_python_that_does_not_fit_is_refused_in_a_line_and_leaves_nothing(
    tmp_path: Path, before: str | None, said: str
) -> None:
    python = "nowhere/python" if before is None else python_that(tmp_path, before)
    folder, done = make(tmp_path, python, "demo")
    line, *rest = done.stderr.splitlines()
    assert said in line and done.returncode != 0
    assert len(rest) == 1 and rest[0].startswith("make: *** "), done.stderr
    assert not (folder / ".venv").exists()


@pytest.mark.slow
def test_make_replaces_a_venv_that_another_python_or_half_an_install_left(tmp_path: Path) -> None:
    """Without an index the install itself ends in an error; what is made before is whole all the same."""
    bin_folder = tmp_path / "checkout" / ".venv" / "bin"
    bin_folder.mkdir(parents=True)
    (bin_folder / "python").symlink_to("/nowhere/python3.9")  # venv itself keeps a link that is there
    make(tmp_path, sys.executable)
    found = subprocess.run(
        [bin_folder / "python", "-c", "import pip, sys; print(sys.version)"], capture_output=True, text=True
    )
    assert found.stdout.strip() == sys.version, found.stderr
    kept = bin_folder.parent / "kept"
    kept.touch()
    make(tmp_path, sys.executable)
    assert kept.exists(), "what is whole is gone on with"
