"""Builds: digests of the code that makes data.

A digest covers the modules that a stage imports, which are found by reading their sources.

A build is part of every content key. So a change of a file that a result depends on changes its
key, and a change of any other file does not. Four rules say which imports are followed:

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


# The list of kinds decides on nothing by itself, and it would make every build depend on every
# kind. The documents that it leads to are in the content keys as a whole. A store returns the bytes
# that a digest names, or none, so no result depends on how it does that.
UNCOUNTED = ("stickslip_schemas.kinds", "stickslip_schemas.store", "stickslip_schemas.store.*")
"""Modules that no build counts."""

PREFIX = "stickslip_"
"""Prefix of the names of our packages."""


def sources(roots: Iterable[str], *, cut: Collection[str] = ()) -> dict[str, Path]:
    """Return the source files of the modules `roots` and of all that they import.

    The keys are paths below the folders of our packages.

    Modules in `cut` are left out; `package.*` stands for all that is below a package. Raises
    ModuleNotFoundError.
    """
    files: dict[str, Path] = {}
    # A walk over the graph of imports, from the roots on.
    pending = list(roots)
    visited: set[str] = set()
    while pending:
        name = pending.pop()
        if name in visited or _is_cut(name, cut):
            continue
        visited.add(name)
        path = module_file(name)
        # The build of a compiled module is the hash of its sources, which it states itself.
        if path is None:
            continue
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        # Paths below our packages are the same on every machine, whatever the folder of the
        # installation.
        for file in (path, *_data_files(path)):
            files["/".join([*package.split("."), file.name])] = file
        pending += _imports(path)
    return files


def digests(files: dict[str, Path]) -> dict[str, str]:
    """Return the SHA-256 of each file, in the order of their names."""
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
    # An editable installation may add a folder that has only the compiled module.
    folders = [Path(folder) for folder in spec.submodule_search_locations]
    return next(folder for folder in folders if (folder / "__init__.py").is_file())


def _is_cut(name: str, cut: Collection[str]) -> bool:
    parents = name.split(".")
    return name in cut or any(
        ".".join([*parents[:length], "*"]) in cut for length in range(1, len(parents))
    )


def _data_files(module: Path) -> list[Path]:
    """Return the files beside a module that it names."""
    strings = {node.value for node in ast.walk(_parse(module)) if isinstance(node, ast.Constant)}
    # Sources beside it count only if it imports them, which `sources` follows.
    return [
        file
        for file in sorted(module.parent.iterdir())
        if file.is_file() and file.suffix not in (".py", ".pyi") and file.name in strings
    ]


def _imports(path: Path) -> Iterator[str]:
    """Yield the modules of ours that a file imports."""
    for node in _import_nodes(_parse(path)):
        if isinstance(node, ast.Import):
            # An import of whole modules.
            yield from (alias.name for alias in node.names if alias.name.startswith(PREFIX))
        elif (node.module or "").startswith(PREFIX):
            # An import of names: each may be a module, or passed on from another one.
            for alias in node.names:
                yield _defining_module(str(node.module), alias.name)


def _import_nodes(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        # What only type checkers import decides on no result.
        elif not (isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")):
            yield from _import_nodes(node)


def _defining_module(module: str, name: str) -> str:
    """Return the module that `from module import name` gets the name from."""
    path = module_file(module)
    # Only the `__init__` of a package passes names on.
    if path is None or path.name != "__init__.py":
        return module
    if _is_submodule(path.parent, name):
        return f"{module}.{name}"
    for node in _import_nodes(_parse(path)):
        if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith(PREFIX):
            continue
        for alias in node.names:
            if (alias.asname or alias.name) == name:
                return _defining_module(str(node.module), alias.name)
    return module


def _is_submodule(package: Path, name: str) -> bool:
    sources = (package / f"{name}.py", package / f"{name}.pyi")
    return (package / name).is_dir() or any(source.is_file() for source in sources)


@cache
def _parse_version(path: Path, _modified_ns: int) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _parse(path: Path) -> ast.Module:
    # The time of the last change is part of the cache's key: a process may outlive an edit.
    return _parse_version(path, path.stat().st_mtime_ns)
