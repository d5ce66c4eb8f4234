"""What one clip's life runs through: `python -m tests.house.clips_life <Argoverse 2 sensor root> [files=true]`.

The first clip of log 7fab2350, driven by PDM-Closed without pictures, in this process: the project's files and
functions that are called while the graph runs (compiled kernels are not seen, and what a file does while it is imported
does not count), and the modules, packages' own files aside, that `factory.run` reaches by import statements, wherever
in a file these stand.
"""

import ast
import sys
import tempfile
import threading
from pathlib import Path
from types import CodeType, FrameType

REPOSITORY = Path(__file__).parents[2]
PACKAGES = ("tasks", "factory", "planners")
LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def called(arguments: list[str]) -> set[CodeType]:
    """The project's functions that are called between the beginning and the end of a run's graph."""
    from factory.graph.execute import execute
    from factory.run import main

    graph, depth, seen = execute.__code__, 0, set()

    def note(frame: FrameType, event: str, _: object) -> None:
        nonlocal depth
        if frame.f_code is graph:
            depth += {"call": 1, "return": -1}.get(event, 0)
        if event == "call" and depth:
            seen.add(frame.f_code)

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        code = main(arguments)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]
    assert code == 0, code
    folders = tuple(f"{REPOSITORY / package}/" for package in PACKAGES)
    return {code for code in seen if code.co_filename.startswith(folders) and not code.co_name.startswith("<")}


def file_of(module: str) -> Path | None:
    """A module's file, or none where it is not the project's."""
    place = REPOSITORY.joinpath(*module.split("."))
    return next((f for f in (place / "__init__.py", place.with_suffix(".py")) if f.is_file()), None)


def imported_by(file: Path) -> set[str]:
    """The project's modules that a file names in import statements, and their packages."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            if name.split(".")[0] in PACKAGES:
                parts = name.split(".")
                found.update(".".join(parts[: n + 1]) for n in range(len(parts)))
    return {name for name in found if file_of(name)}


def reached(module: str) -> set[str]:
    """All modules that one reaches, itself included."""
    seen, left = {module}, [module]
    while left:
        file = file_of(left.pop())
        assert file is not None
        new = imported_by(file) - seen
        seen |= new
        left += new
    return seen


def main() -> int:
    """Print the counts, and with `files=true` the files in the order of their names."""
    root, *rest = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        words = ["clips=av2", f"clips.root={Path(root).resolve()}/val/{LOG}", "experts=[pdm_closed]", "limit=1"]
        codes = called([*words, "render=none", "executor=local", f"out={folder}/run"])
    files = sorted({code.co_filename for code in codes})
    if "files=true" in rest:
        for name in files:
            print(Path(name).relative_to(REPOSITORY), sum(code.co_filename == name for code in codes))
    modules = [name for name in reached("factory.run") if not str(file_of(name)).endswith("/__init__.py")]
    print(f"{len(files)} files and {len(codes)} functions; factory.run reaches {len(modules)} modules by its imports")
    return 0


if __name__ == "__main__":
    sys.exit(main())
