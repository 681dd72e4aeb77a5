"""Validation by a JSON schema, for the keywords of draft 2020-12 in docs/*.schema.json."""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

_KNOWN = {
    "$schema", "$defs", "$ref", "title", "description", "type", "enum", "required", "properties",
    "additionalProperties", "items", "minItems", "maxItems", "minimum", "maximum", "pattern",
}  # fmt: skip
_TYPES: Mapping[str, Any] = {
    "object": dict, "array": list, "string": str, "boolean": bool, "null": type(None),
    "integer": int, "number": (int, float),
}  # fmt: skip


def faults(value: Any, schema: Mapping[str, Any], at: str = "$", root: Any = None) -> Iterator[str]:
    """Yield a sentence for each violation of the schema.

    Raises ValueError for a schema with unsupported keywords.
    """
    root = schema if root is None else root
    if "$ref" in schema:
        schema = root["$defs"][schema["$ref"].removeprefix("#/$defs/")]
    if not schema.keys() <= _KNOWN:
        raise ValueError(f"the schema of {at} says {schema.keys() - _KNOWN}")
    kinds = schema.get("type", list(_TYPES))
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if not any(_is_a(value, kind) for kind in kinds):
        yield f"{at} is {value!r}, not {' or '.join(kinds)}"
        return
    if "enum" in schema and value not in schema["enum"]:
        yield f"{at} is {value!r}, which is none of {schema['enum']}"
    if isinstance(value, str) and not re.search(schema.get("pattern", ""), value):
        yield f"{at} is {value!r}, not like {schema['pattern']}"
    if isinstance(value, int | float) and not isinstance(value, bool):
        least, most = schema.get("minimum", -math.inf), schema.get("maximum", math.inf)
        if not (math.isfinite(value) and least <= value <= most):
            yield f"{at} is {value}, not a number from {least} to {most}"
    if isinstance(value, list):
        if not schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", math.inf):
            yield f"{at} has {len(value)} items"
        for number, item in enumerate(value):
            yield from faults(item, schema.get("items", {}), f"{at}[{number}]", root)
    if isinstance(value, dict):
        for name in schema.get("required", []):
            if name not in value:
                yield f"{at} has no {name}"
        others = schema.get("additionalProperties", {})
        for name, item in value.items():
            inner = schema.get("properties", {}).get(name, others)
            yield from faults(item, inner, f"{at}.{name}", root)


def _is_a(value: Any, kind: str) -> bool:
    if isinstance(value, bool):
        return kind == "boolean"
    return isinstance(value, _TYPES[kind])
