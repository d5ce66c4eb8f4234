"""Names to be read by strangers: `python -m tests.house.names seed=1 [n=60] [docs=true]`.

Draws functions and classes at random and prints their names and signatures alone. A reader who has not seen the code
writes a sentence on what each does; it is wrong where it contradicts the docstring, which `docs=true` adds.
"""

import ast
import random
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
PACKAGES = ("tasks", "factory", "planners")


def signature_of(node: ast.FunctionDef | ast.ClassDef) -> str:
    """As it stands in the file, on one line; of a class its bases and fields."""
    if isinstance(node, ast.FunctionDef):
        returned = f" -> {ast.unparse(node.returns)}" if node.returns else ""
        return f"def {node.name}({ast.unparse(node.args)}){returned}"
    fields = [ast.unparse(line.target) for line in node.body if isinstance(line, ast.AnnAssign)]
    bases = ", ".join(map(ast.unparse, node.bases))
    return f"class {node.name}({bases})" + (f" with fields {', '.join(fields)}" if fields else "")


def documented(path: Path) -> list[tuple[str, str]]:
    """(signature, docstring) of the functions and classes of a file that have one; methods aside."""
    found = []
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and (said := ast.get_docstring(node)):
            where = ".".join(path.relative_to(REPOSITORY).with_suffix("").parts)
            found.append((f"{where}: {signature_of(node)}", said))
    return found


def main() -> int:
    """Print the draw."""
    given = dict(word.split("=", 1) for word in sys.argv[1:])
    files = sorted(path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py"))
    there = [one for path in files for one in documented(path)]
    for number, (signature, said) in enumerate(random.Random(given["seed"]).sample(there, int(given.get("n", 60))), 1):
        print(f"{number}. {signature}" + (f"\n     {said}" if "docs" in given else ""))
    return 0


if __name__ == "__main__":
    sys.exit(main())
