"""The YAML of specs and scenes: the core schema of YAML 1.2, with merge keys.

PyYAML reads YAML 1.1, in which `010` is 8, `1:30` is 90, `.2e7` and `1e-3` are words, and `no` is
false. Here numbers, booleans and null are as in YAML 1.2.2, section 10.3.2, as in ruamel.yaml
and in other languages. Everything else that is not quoted is a word: dates, `yes` and `1_000`, too.

A key must be a word, and be there once. A merge key `<<: *NAME` adds the keys of another mapping.

A document may be hostile: nesting is limited, and aliases are counted while they expand, so that
400 bytes cannot stand for a billion values.
"""

import re
from typing import Any

import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError
from yaml.events import AliasEvent

MAX_DEPTH = 100
"""Nested lists and mappings in one another; a scene has about 10."""

MAX_ALIASED_VALUES = 100_000
"""Values that all aliases of a document stand for; a fabric has about 30."""

_FLOAT = re.compile(
    r"""[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?
    |[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)""",
    re.VERBOSE,
)
_INT = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_BOOL = re.compile(r"true|True|TRUE|false|False|FALSE")
_NULL = re.compile(r"~|null|Null|NULL|")

_TAG = "tag:yaml.org,2002:"
_MERGE = f"{_TAG}merge"


class _Loader(yaml.SafeLoader):
    """A loader of the core schema of YAML 1.2."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0
        self._value_count = 0
        """Values so far, with aliases expanded."""
        self._aliased_count = 0
        """Values so far that aliases stand for."""
        self._expanded_sizes: dict[int, int] = {}
        """Values of each finished node, by its identity."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Compose a node, and count the values that it stands for."""
        event = self.peek_event()  # type: ignore[no-untyped-call]
        mark: Any = event.start_mark
        count_before = self._value_count
        self._depth += 1
        if self._depth > MAX_DEPTH:
            problem = f"lists and mappings must be nested at most {MAX_DEPTH} deep"
            raise ComposerError(None, None, problem, mark)
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(event, AliasEvent):
            # A node that is not finished contains its own alias, and would never end.
            if id(node) not in self._expanded_sizes:
                problem = f"the alias *{event.anchor} must not stand inside of its own anchor"
                raise ComposerError(None, None, problem, mark)
            self._value_count += self._expanded_sizes[id(node)]
            self._aliased_count += self._expanded_sizes[id(node)]
            if self._aliased_count > MAX_ALIASED_VALUES:
                problem = f"aliases must stand for at most {MAX_ALIASED_VALUES} values together"
                raise ComposerError(None, None, problem, mark)
        else:
            self._value_count += 1
            self._expanded_sizes[id(node)] = self._value_count - count_before
        return node

    def get_single_node(self) -> yaml.Node | None:
        """Return the document of a file; a second one is refused in plain words."""
        try:
            return super().get_single_node()
        except ComposerError as error:
            if error.context != "expected a single document in the stream":
                raise
            problem = "a file must have one document, and --- begins another one"
            raise ComposerError(None, None, problem, error.problem_mark) from error

    def refuse_tag(self, node: yaml.Node) -> Any:
        """Refuse a tag, which would ask for an object of a programming language."""
        tag = node.tag.replace(_TAG, "!!")
        problem = f"the tag {tag} must not be there: a value has no tag, or that of its type"
        raise ConstructorError(None, None, problem, node.start_mark)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping whose keys are words, each there once."""
        keys: set[str] = set()
        for key_node, _ in node.value:
            # Merged keys may be there a second time: those of the mapping itself win.
            if key_node.tag == _MERGE:
                continue
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                problem = f"the key {key!r} is no word: write it in quotes"
                raise ConstructorError(None, None, problem, key_node.start_mark)
            if key in keys:
                problem = f"the key {key!r} is there twice"
                raise ConstructorError(None, None, problem, key_node.start_mark)
            keys.add(key)
        return super().construct_mapping(node, deep)

    def construct_number(self, node: yaml.ScalarNode) -> int:
        """Construct a whole number: decimal, also after zeros, `0o` octal or `0x` hexadecimal."""
        text = str(self.construct_scalar(node))
        for prefix, base in (("0o", 8), ("0x", 16)):
            if text.startswith(prefix):
                return int(text, base)
        try:
            return int(text)
        # Python reads at most 4,300 digits, because its time grows with their square.
        except ValueError as error:
            problem = f"{text[:40]!r} must be a whole number of at most 4,300 digits"
            raise ConstructorError(None, None, problem, node.start_mark) from error

    def construct_decimal(self, node: yaml.ScalarNode) -> float:
        """Construct a number with a point or an exponent, an infinity or NaN."""
        text = str(self.construct_scalar(node)).lower()
        # Python writes infinities and NaN without a point.
        if text.endswith(("inf", "nan")):
            text = text.replace(".", "")
        try:
            return float(text)
        except ValueError as error:
            problem = f"{text[:40]!r} must be a number"
            raise ConstructorError(None, None, problem, node.start_mark) from error


# The rules of YAML 1.1 do not apply: only those added below do.
_Loader.yaml_implicit_resolvers = {}


def _add(name: str, pattern: re.Pattern[str], first_letters: str) -> None:
    full = re.compile(rf"^(?:{pattern.pattern})$", pattern.flags)
    _Loader.add_implicit_resolver(f"{_TAG}{name}", full, list(first_letters) or [""])


# The first rule that fits counts: a whole number is not read as a decimal one.
_add("null", _NULL, "~nN")
_add("null", _NULL, "")
_add("bool", _BOOL, "tTfF")
_add("int", _INT, "-+0123456789")
_add("float", _FLOAT, "-+.0123456789")
_add("merge", re.compile("<<"), "<")
_Loader.add_constructor(None, _Loader.refuse_tag)
_Loader.add_constructor(f"{_TAG}int", _Loader.construct_number)
_Loader.add_constructor(f"{_TAG}float", _Loader.construct_decimal)


def parse_yaml(text: str) -> Any:
    """Return the document of a YAML file.

    Raises:
        yaml.YAMLError: The text is not YAML, or breaks a rule or limit of this module.
    """
    return yaml.load(text, _Loader)
