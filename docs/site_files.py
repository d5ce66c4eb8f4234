"""What the site is made of: the pages where they lie in the repository, what they link to, and two pages from the code.

MkDocs calls the functions named on_*; mkdocs.yml has the rest.
"""

import re
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from factory.commands.table import DOORS

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("docs", "deploy", "experiments")  # of pages
LINK = re.compile(r"\]\(([^)\s#]+)[^)]*\)")
IN_PYTHON = (  # what others build on
    "tasks.trajectories",
    "tasks.world.clip",
    "tasks.world.clip",
    "tasks.world.road_map",
    "tasks.experts.protocol",
    "factory.store.reader",
    "factory.readers.base",
    "factory.readers.logs",
    "planners.models.planner",
)


def pages() -> list[Path]:
    """Every page of the repository."""
    return sorted([*ROOT.glob("*.md"), *(page for folder in FOLDERS for page in (ROOT / folder).rglob("*.md"))])


def commands_page() -> str:
    """Every command with its own --help; what others repeat of the run's settings is left to the run."""
    page = ["# Commands", "", "As the commands themselves say it with `--help`."]
    run_help = help_of("factory", "run")
    for door, commands in DOORS.items():
        page += ["", f"## python -m {door}"]
        for name, command in commands.items():
            told = help_of(door, name)
            if name != "run":
                told = told.replace(run_help, "those of run, above\n")
            page += ["", f"### {name}", "", f"{command.about}.", "", "```text", told.rstrip(), "```"]
    return "\n".join(page)


def help_of(door: str, name: str) -> str:
    """What a command prints for --help. Raises RuntimeError where it fails."""
    told = StringIO()
    with redirect_stdout(told):
        code = DOORS[door][name].load()(["--help"])
    if code != 0:
        raise RuntimeError(f"python -m {door} {name} --help ends with {code}")
    return told.getvalue()


def python_page() -> str:
    """The public names of the modules that others build on, from their docstrings."""
    listed = "".join(f"\n::: {module}\n" for module in IN_PYTHON)
    return f"# In Python\n\nWhat scripts, readers, experts and planners of your own import.\n{listed}"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The experiments' pages close the last section."""
    (results,) = config.nav[-1].values()
    results += sorted(str(path.relative_to(ROOT)) for path in (ROOT / "experiments").rglob("*.md"))
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The theme's files, the pages under their paths in the repository, and every file that a page links to."""
    site = Files([file for file in files if file.src_dir != config.docs_dir])
    made = {"docs/commands.md": commands_page(), "docs/python.md": python_page()}
    for name, text in made.items():
        site.append(File.generated(config, name, content=text))
    for page in pages():
        linked = [(page.parent / target).resolve() for target in LINK.findall(page.read_text()) if ":" not in target]
        for path in (page, *filter(Path.is_file, linked)):
            name = path.relative_to(ROOT).as_posix()
            if name not in site.src_uris:
                site.append(File.generated(config, name, abs_src_path=str(path)))
    return site
