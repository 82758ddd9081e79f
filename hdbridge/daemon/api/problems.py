"""Errors of the API as ``application/problem+json`` (RFC 9457), never with a stack trace."""

import logging
from collections.abc import Callable, Coroutine
from http import HTTPStatus
from typing import Any, Final

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException

from hdbridge.client.messages import CONTENT_TYPE, TYPE_PREFIX, Problem
from hdbridge.errors import HdbridgeError, InputError
from hdbridge.strictness import complaint

COMPLAINTS_MAXIMUM = 20
_log = logging.getLogger(__name__)


class UnknownError(InputError):
    """The object in the path does not exist."""


def refusal(status: int, detail: str, kind: str = "DaemonError", hint: str | None = None) -> Problem:
    """Returns a problem for an error without an `HdbridgeError`."""
    title = HTTPStatus(status).phrase
    return Problem(type=f"{TYPE_PREFIX}{kind}", title=title, status=status, detail=detail, hint=hint)


def answer(problem: Problem) -> Response:
    """Returns the response for a problem."""
    content = problem.model_dump_json(exclude_none=True)
    headers = {"WWW-Authenticate": "Bearer"} if problem.status == HTTPStatus.UNAUTHORIZED else None
    return Response(content, problem.status, headers, CONTENT_TYPE)


async def _on_hdbridge_error(request: Request, error: HdbridgeError) -> Response:
    problem = Problem.of(error, request.path_params.get("axis"))
    if isinstance(error, UnknownError):
        problem = refusal(404, str(error), "InputError")
    return answer(problem)


async def _on_validation_error(request: Request, error: RequestValidationError) -> Response:
    """Answers a request that violates the schema, with one complaint per key, without its value."""
    complaints = []
    for each in error.errors()[:COMPLAINTS_MAXIMUM]:
        place = [part for part in each["loc"] if part != "body"]
        complaints.append(
            _printable(complaint({"type": each["type"], "loc": place, "msg": each["msg"]}, "the body"))
        )
    malformed = any(each["type"] == "json_invalid" for each in error.errors())
    status = HTTPStatus.BAD_REQUEST if malformed else HTTPStatus.UNPROCESSABLE_ENTITY
    problem = refusal(status, "the request is not valid: nothing was done", "InputError")
    problem = problem.model_copy(update={"errors": complaints, "axis": request.path_params.get("axis")})
    return answer(problem)


async def _on_http_exception(_request: Request, error: HTTPException) -> Response:
    kind = "InputError" if error.status_code < HTTPStatus.INTERNAL_SERVER_ERROR else "HdbridgeError"
    response = answer(refusal(error.status_code, _printable(str(error.detail)), kind))
    response.headers.update(error.headers or {})
    return response


async def _on_unexpected_error(request: Request, error: Exception) -> Response:
    """Answers an unexpected error; its details go to the log only."""
    _log.error("failed", {"method": request.method, "path": request.url.path, "error": repr(error)})
    return answer(
        refusal(
            500, "an error in hdbridge, see the daemon's log; the outcome of the request is unknown",
            "HdbridgeError", "check the state before continuing",
        )
    )  # fmt: skip


def _printable(text: str) -> str:
    """Escapes unpaired surrogates, which JSON may contain but UTF-8 may not."""
    return text.encode("utf-8", "backslashreplace").decode()[:400]


HANDLERS: Final[dict[int | type[Exception], Callable[[Request, Any], Coroutine[Any, Any, Response]]]] = {
    HdbridgeError: _on_hdbridge_error,
    RequestValidationError: _on_validation_error,
    HTTPException: _on_http_exception,
    Exception: _on_unexpected_error,
}
"""Error handlers of the application."""
