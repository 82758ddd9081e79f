"""HTML page of the API, generated from its own OpenAPI description, without script or network access."""

from __future__ import annotations

import json
import re
import shlex
from functools import cache
from importlib.resources import files
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

Schema = dict[str, Any]
_METHODS: Final = ("get", "post", "put", "delete")
_BOUNDS: Final = (
    ("exclusiveMinimum", "above {}"),
    ("minimum", "from {}"),
    ("exclusiveMaximum", "below {}"),
    ("maximum", "to {}"),
    ("maxLength", "at most {} characters"),
    ("maxItems", "at most {} entries"),
    ("maxProperties", "at most {} entries"),
)


def page(schema: Schema) -> str:
    """Returns one HTML page: each operation under its tag, with parameters, body, example and errors."""
    sections = [
        (tag, [each for each in _operations(schema) if each["tag"] == tag["name"]]) for tag in schema["tags"]
    ]
    answers = [
        {"name": name, "about": each.get("description", ""), "fields": _fields(schema, each)}
        for name, each in sorted(_answered(schema).items())
    ]
    return str(_template().render(info=schema["info"], sections=sections, answers=answers, style=_style()))


@cache
def _template() -> Any:
    # Everything is escaped, because names and descriptions are plain text.
    environment = Environment(
        loader=PackageLoader("hdbridge.daemon.api"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["words"] = _words
    return environment.get_template("docs.html.j2")


def _words(text: str) -> Markup:
    """Formats text between backticks as code."""
    parts = text.split("`")
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if place % 2 else escape(part)
        for place, part in enumerate(parts)
    )


def _answered(schema: Schema) -> dict[str, Schema]:
    """Returns the types of answers; types of requests are described with their request."""
    asked = {
        _type(each["requestBody"]["content"]["application/json"]["schema"])
        for methods in schema["paths"].values()
        for each in methods.values()
        if "requestBody" in each
    }
    kinds: dict[str, Schema] = schema["components"]["schemas"]
    return {name: each for name, each in kinds.items() if "properties" in each and name not in asked}


def _fields(schema: Schema, model: Schema) -> list[Schema]:
    return [
        _field(schema, name, each, required=name in model.get("required", ()))
        for name, each in model["properties"].items()
    ]


@cache
def _style() -> str:
    return files("hdbridge.report").joinpath("assets/page.css").read_text(encoding="utf-8")


def _operations(schema: Schema) -> list[Schema]:
    found = []
    for path, methods in schema["paths"].items():
        for method in _METHODS:
            if method in methods:
                found.append(_operation(schema, path, method.upper(), methods[method]))
    return found


def _operation(schema: Schema, path: str, method: str, given: Schema) -> Schema:
    body = given.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema")
    model = _resolved(schema, body) if body else None
    example = _example(model) if model else None
    parameters = given.get("parameters", [])
    leased = any(each["name"] == "X-Lease" for each in parameters)
    answer = next(each for status, each in given["responses"].items() if status < "300")
    answered = answer["content"]["application/json"]["schema"]
    return {
        "tag": given["tags"][0],
        "id": given["operationId"],
        "method": method,
        "path": path,
        "about": given.get("description", given["summary"]),
        "leased": leased,
        "parameters": [
            _field(
                schema,
                each["name"],
                {**each["schema"], "description": each.get("description", "")},
                required=each.get("required", False),
            )
            for each in parameters
            if each["name"] != "X-Lease"
        ],
        "fields": _fields(schema, model) if model else [],
        "answer": _type(answered),
        "answers": _type(answered.get("items", answered)),
        "errors": [
            (status, each["description"]) for status, each in given["responses"].items() if status >= "400"
        ],
        "curl": _curl(method, path, example, leased=leased),
    }


def _field(schema: Schema, name: str, given: Schema, *, required: bool = True) -> Schema:
    bounds = []
    for each in (given, *given.get("anyOf", ())):
        resolved = _resolved(schema, each)
        bounds += [words.format(f"{resolved[key]:.16g}") for key, words in _BOUNDS if key in resolved]
    default = "" if required or given.get("default") is None else json.dumps(given["default"])
    return {
        "name": name,
        "type": _type(given),
        "bounds": ", ".join(bounds),
        "default": default,
        "required": required,
        "about": given.get("description", ""),
    }


def _type(given: Schema) -> str:
    if "$ref" in given:
        return str(given["$ref"]).rpartition("/")[2]
    if "anyOf" in given:
        return " or ".join(_type(each) for each in given["anyOf"] if each.get("type") != "null")
    if "enum" in given:
        return " | ".join(map(str, given["enum"]))
    if given.get("type") == "array":
        return f"list of {_type(given.get('items', {}))}"
    if given.get("type") == "object" and "additionalProperties" in given:
        values = given["additionalProperties"]
        return f"{_type(values)} by name" if isinstance(values, dict) else "object"
    return str(given.get("const", given.get("type", "any")))


def _resolved(schema: Schema, given: Schema) -> Schema:
    if "$ref" not in given:
        return given
    found: Schema = schema["components"]["schemas"][str(given["$ref"]).rpartition("/")[2]]
    return found


def _example(model: Schema) -> Any:
    """Builds an example from the examples of the required fields."""
    if "examples" in model:
        return model["examples"][0]
    required = model.get("required", ())
    properties = model.get("properties", {})
    shown = {name: each for name, each in properties.items() if name in required} or properties
    return {
        name: each["examples"][0] if "examples" in each else each.get("default")
        for name, each in shown.items()
        if "examples" in each or "default" in each
    }


def _curl(method: str, path: str, example: Any, *, leased: bool) -> str:
    words = ["curl", "--unix-socket", "$HDBRIDGE_SOCKET"]
    words += ["-X", method] if method != ("GET" if example is None else "POST") else []
    words += ["-H", '"X-Lease: $LEASE"'] if leased else []
    if example is not None:
        words += ["--json", shlex.quote(json.dumps(example))]
    address = re.sub(r"\{(\w+)\}", lambda name: name[1].upper(), path)
    return " ".join([*words, f"http://localhost{address}"])
