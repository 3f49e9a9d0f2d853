"""YAML files read into models, and what is wrong with them in words."""

from __future__ import annotations

import difflib
import reprlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import yaml
from pydantic import AfterValidator, ValidationError

from vinemap.config.settings import Options
from vinemap.errors import ConfigError, InputError, reason_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from pydantic_core import ErrorDetails

M = TypeVar("M", bound=Options)
T = TypeVar("T")
_short = reprlib.Repr()
_short.maxstring = _short.maxother = 80


def checked_by(check: Callable[[T], Any]) -> AfterValidator:
    """A check that raises errors of ours, for pydantic."""

    def checked(value: T) -> T:
        try:
            check(value)
        except (ConfigError, InputError) as error:
            raise ValueError(str(error)) from error
        return value

    return AfterValidator(checked)


def merge(common: Any, own: Any) -> Any:
    """Options with others laid over them, key by key; null is one, but where it stands for a section."""
    if not isinstance(common, dict) or common is own:
        return own
    if isinstance(own, dict):
        return common | {key: merge(common.get(key), value) for key, value in own.items()}
    return common if own is None else own


def nearest(word: str, known: list[str]) -> str:
    """What somebody may have meant by a word, or else all that is known."""
    lower = {k.lower(): k for k in known}
    close = difflib.get_close_matches(word.lower(), list(lower), n=1, cutoff=0.5)
    return f"did you mean {lower[close[0]]!r}?" if close else f"known are {', '.join(known)}"


class _Loader(yaml.SafeLoader):
    """YAML in which a date is a word and no key stands twice."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise yaml.constructor.ConstructorError(
                problem=f"{', '.join(twice)} stands there twice", problem_mark=node.start_mark
            )
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """What a YAML file holds; ConfigError if it can't be read."""
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _Loader)  # noqa: S506 - a SafeLoader
    except (FileNotFoundError, NotADirectoryError) as error:
        folder = path.parent if path.parent.is_dir() else Path()
        known = [str(p) for p in sorted(folder.glob("*.yaml"))]
        hint = nearest(str(path), known) if known else "vinemap config prints such files"
        raise ConfigError(f"{path}: no such file: {hint}") from error
    except IsADirectoryError as error:
        raise ConfigError(f"{path}: is a folder: name the file in it") from error
    except OSError as error:
        raise ConfigError(f"{path}: can't be read ({error.strerror})") from error
    except Exception as error:  # a YAMLError, or others of tags in odd places
        reason = reason_of(error)
        raise ConfigError(f"{path}: no valid YAML ({reason})") from error
    return {} if data is None else data


def validated(model: type[M], data: Any, path: Path | None) -> M:
    """A model of what was read from a file; ConfigError names every key that is wrong, its value and what it may be."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        # A parcel that inherits what is wrong for all needn't say so once more.
        reasons = dict.fromkeys(_explain(e, model) for e in _own(error.errors()))
        raise ConfigError(f"{path or 'survey'}: {'; '.join(reasons)}") from error


def _own(errors: list[ErrorDetails]) -> list[ErrorDetails]:
    known = [(error, _short.repr(error["input"])) for error in errors]
    common = {(error["loc"], value) for error, value in known}
    return [e for e, value in known if e["loc"][:1] != ("overrides",) or (e["loc"][2:], value) not in common]


def _explain(error: ErrorDetails, model: type[Options]) -> str:
    place = ".".join(str(part) for part in error["loc"]) or "the file"
    if error["type"] == "extra_forbidden":
        keys = list(_model_at(model, error["loc"][:-1]).model_fields)
        return f"unknown key {place}: {nearest(str(error['loc'][-1]), keys)}"
    if error["type"] == "missing":
        return f"{place} is missing"
    message = error["msg"].removeprefix("Value error, ")
    value = _short.repr(error["input"])
    a_word = error["type"] == "string_type" and isinstance(error["input"], (bool, int, float))
    hint = ": put it in quotes" if a_word else ""
    return f"{place} = {value if len(value) < 80 else value[:80] + '…'}: {message[0].lower()}{message[1:]}{hint}"


def _model_at(model: type[Options], loc: tuple[int | str, ...]) -> type[Options]:
    for part in loc:
        annotation = model.model_fields[str(part)].annotation if str(part) in model.model_fields else None
        candidates = [annotation, *get_args(annotation)]
        model = next((c for c in candidates if isinstance(c, type) and issubclass(c, Options)), model)
    return model
