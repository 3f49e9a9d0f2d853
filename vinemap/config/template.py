"""Configurations to start from: every key with its default, what it means, and what it may be."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

import yaml
from pydantic_core import PydanticUndefined

from vinemap.config.camera import Camera
from vinemap.config.settings import Options, Settings
from vinemap.config.surveys import EstateConfig, SurveyConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pydantic.fields import FieldInfo

KINDS: dict[str, type[Options]] = {
    "estate": EstateConfig,
    "survey": SurveyConfig,
    "settings": Settings,
    "camera": Camera,
}
"""What can be configured: an estate's surveys night after night, one survey, the stages alone, a robot's camera."""
LIMITS = {"ge": "from", "gt": "above", "le": "to", "lt": "below"}


def template(kind: str) -> str:
    """YAML with all keys of one of ``KINDS`` at their defaults, each with a comment.

    Without changes it configures what stands there already, but for what must be given, which stands as an example.
    """
    model = KINDS[kind]
    needed = [name for name, field in model.model_fields.items() if field.examples]
    free = f"{', '.join(needed)} must be given, all others" if needed else "Every key"
    head = [f"# {_sentence(model)}", f"# {free} may be left out: these are the defaults.", ""]
    return "\n".join([*head, *_lines(model, "")]) + "\n"


def _lines(model: type[Options], indent: str) -> Iterator[str]:
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, Options):
            yield f"{indent}# {_sentence(inner)}"
            yield f"{indent}{name}:"
            yield from _lines(inner, indent + "  ")
        else:
            bounds = _bounds(field)
            yield f"{indent}{name}: {_default(field, name)}  # {field.description}{f' ({bounds})' if bounds else ''}"


def _sentence(model: type[Options]) -> str:
    return (model.__doc__ or "").strip().splitlines()[0]


def _default(field: FieldInfo, name: str) -> str:
    value = (field.examples or [name])[0] if field.default is PydanticUndefined else field.default
    value = list(value) if isinstance(value, tuple) else value
    plain = value if value is None or isinstance(value, (bool, int, float, dict, list)) else str(value)
    return yaml.safe_dump(plain, default_flow_style=True, width=200).splitlines()[0]


def _bounds(field: FieldInfo) -> str:
    """What a value may be, in words."""
    limits = {word: getattr(m, key) for m in field.metadata for key, word in LIMITS.items() if hasattr(m, key)}
    choices = [choice for kind in (field.annotation, *get_args(field.annotation)) for choice in _choices(kind)]
    return " ".join(f"{word} {value:.10g}" for word, value in limits.items()) or " or ".join(choices)


def _choices(kind: Any) -> tuple[str, ...]:
    return get_args(kind) if get_origin(kind) is Literal else ()
