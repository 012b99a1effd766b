"""Builds: digests of the code that makes data, over the modules that a stage imports, found by
reading their sources.

A build is part of every content key. So a change of a file that a result depends on changes its
key, and a change of any other file does not. Four rules say what is followed:

- An import counts wherever it stands, also inside a function; `if TYPE_CHECKING:` does not count.
- A name that a package's `__init__` only passes on leads to the module that defines it.
- A module also counts the data files beside it that it names in a string.
- A module that is cut is neither counted nor followed. The caller says why.
"""

import ast
from collections.abc import Collection, Iterable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from stickslip_schemas.base import Document, Sha256, Stage, content_key, sha256


class Builds(Document):
    """Build digests of one kind.

    Tasks are leased only to workers of the builds they were planned for.

    Each digest is over the files that the work of that stage imports, over compilers, libraries and
    settings, so equal digests mean equal results.
    """

    sim_core: Sha256
    """The solver alone, which certificates cover."""
    simulate: Sha256
    """Solver, scene and simulate stage."""
    render: Sha256
    """Renderer and scene."""
    pack: Sha256
    """Arrays, codecs and metadata of a dataset."""

    @property
    def digest(self) -> str:
        return content_key("builds", self.model_dump())

    @property
    def by_stage(self) -> dict[Stage, str]:
        """The build that a worker needs to run a task, by stage."""
        return dict(zip(Stage, (self.simulate, self.render, self.pack, self.digest), strict=True))


UNCOUNTED = ("stickslip_schemas.kinds", "stickslip_schemas.store", "stickslip_schemas.store.*")
"""What builds cut. The list of kinds decides on nothing by itself, and it would make every build
depend on every kind. The documents that it leads to are in the content keys as a whole. A store
gives the bytes that a digest names, or none: no result depends on how."""

OURS = "stickslip_"
"""How the names of our packages begin."""


def sources(roots: Iterable[str], *, cut: Collection[str] = ()) -> dict[str, Path]:
    """Return the files that the modules `roots` are made of, by their paths below the folders of
    our packages.

    Modules in `cut` are left out; `package.*` stands for all that is below a package. Raises
    ModuleNotFoundError.
    """
    found: dict[str, Path] = {}
    waiting, seen = list(roots), set()
    while waiting:
        name = waiting.pop()
        if name in seen or _is_cut(name, cut):
            continue
        seen.add(name)
        path = module_file(name)
        if path is None:  # compiled; its build is known by other means
            continue
        folder = name if path.name == "__init__.py" else name.rpartition(".")[0]
        for file in (path, *_data_files(path)):
            found["/".join([*folder.split("."), file.name])] = file
        waiting += _imports(path)
    return found


def digests(files: dict[str, Path]) -> dict[str, str]:
    return {name: sha256(path.read_bytes()) for name, path in sorted(files.items())}


def module_file(name: str) -> Path | None:
    """Return the source of a module of ours, None if it is compiled; raise ModuleNotFoundError."""
    package, *rest = name.split(".")
    base = _package_folder(package).joinpath(*rest)
    if (base / "__init__.py").is_file():
        return base / "__init__.py"
    if base.with_suffix(".py").is_file():
        return base.with_suffix(".py")
    if rest and rest[-1].startswith("_") and base.with_suffix(".pyi").is_file():
        return None
    raise ModuleNotFoundError(f"there is no source of module {name}", name=name)


@cache
def _package_folder(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"there is no package {package}", name=package)
    folders = [Path(place) for place in spec.submodule_search_locations]
    return next(folder for folder in folders if (folder / "__init__.py").is_file())


def _is_cut(name: str, cut: Collection[str]) -> bool:
    parents = name.split(".")
    return name in cut or any(
        ".".join([*parents[:length], "*"]) in cut for length in range(1, len(parents))
    )


def _data_files(module: Path) -> list[Path]:
    """Return the files beside a module that it names."""
    words = {node.value for node in ast.walk(_parsed(module)) if isinstance(node, ast.Constant)}
    beside = (
        file
        for file in sorted(module.parent.iterdir())
        if file.is_file() and file.suffix not in (".py", ".pyi")
    )
    return [file for file in beside if file.name in words]


def _imports(path: Path) -> Iterator[str]:
    """Yield the modules of ours that a file imports."""
    for node in _import_nodes(_parsed(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith(OURS))
        elif (node.module or "").startswith(OURS):
            for alias in node.names:
                yield _home(str(node.module), alias.name)


def _import_nodes(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif not (isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")):
            yield from _import_nodes(node)


def _home(module: str, name: str) -> str:
    """Return the module that `from module import name` gets the name from."""
    path = module_file(module)
    if path is None or path.name != "__init__.py":
        return module
    if (path.parent / name).is_dir() or any(
        (path.parent / f"{name}{end}").is_file() for end in (".py", ".pyi")
    ):
        return f"{module}.{name}"
    for node in _import_nodes(_parsed(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(OURS):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return _home(str(node.module), alias.name)
    return module


@cache
def _parsed_text(path: Path, _changed: int) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _parsed(path: Path) -> ast.Module:
    return _parsed_text(path, path.stat().st_mtime_ns)
