"""Application: all routes over one `Bridge`, errors as problem documents, and the API description."""

from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response
from prometheus_client import CONTENT_TYPE_LATEST

from hdbridge import __version__
from hdbridge.client.messages import CONTENT_TYPE
from hdbridge.daemon.api import problems
from hdbridge.daemon.api.metrics import Metrics
from hdbridge.daemon.api.routes import axis, machine, sockets
from hdbridge.daemon.page import PAGE, PageFiles
from hdbridge.daemon.service.bridge import ServiceBridge

PREFIX: Final = "/api/v1"
TAGS: Final = (
    ("Look", "State of the machine. No lease is needed, and no request moves anything."),
    ("Lease", "The right to move, held by one client at a time while it uses it."),
    ("Stop", "Never refused to an authorised client; no lease is needed."),
    (
        "Power",
        "Enable, disable, reset. These and all requests below need the lease, in the header `X-Lease`.",
    ),
    ("Move", "Targets are load angles in degrees, within the axis's limits."),
    ("Compensate", "Model and the part of it that compensates; adaptation to the load encoder."),
    ("Drive", "Objects of the drive's dictionary, by SDO."),
)
_ABOUT: Final = (
    "Load-side targets for the axes of one machine. Angles are degrees at the load unless the name says "
    "`motor`; errors and corrections are arcseconds at the load. Nothing moves by GET. Errors are "
    "`application/problem+json` (RFC 9457)."
)


def create_app(bridge: ServiceBridge, metrics: Metrics) -> FastAPI:
    """Returns the ASGI application. The guard of each listener controls the access to it."""
    app = FastAPI(
        title="hdbridge",
        version=__version__,
        summary="The daemon that controls the drives of one bus",
        description=_ABOUT,
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        openapi_tags=[{"name": name, "description": about} for name, about in TAGS],
        generate_unique_id_function=lambda route: route.name,
        redirect_slashes=False,
        exception_handlers=problems.HANDLERS,
    )
    app.state.bridge = bridge
    for each in (machine, axis, sockets):
        app.include_router(each.routes, prefix=PREFIX)
    _add_pages(app, bridge, metrics)
    app.openapi = lambda: _schema(app)  # type: ignore[method-assign]
    return app


def _add_pages(app: FastAPI, bridge: ServiceBridge, metrics: Metrics) -> None:
    page = PageFiles()
    app.mount("/page", page)

    @app.get(f"{PREFIX}/openapi.json", include_in_schema=False)
    async def get_description() -> JSONResponse:
        """Returns the description of the API, OpenAPI 3.1."""
        return JSONResponse(app.openapi())

    @app.get("/", include_in_schema=False)
    async def get_page(request: Request) -> Response:
        """Returns the live page."""
        return await page.get_response(PAGE, request.scope)

    @app.get("/metrics", include_in_schema=False)
    async def get_metrics() -> Response:
        """Returns metrics for Prometheus."""
        return Response(metrics.exposition(), media_type=CONTENT_TYPE_LATEST)

    @app.get("/healthz", include_in_schema=False)
    async def get_health() -> Response:
        """Returns 200 while the control loop runs, else 503."""
        alive = bridge.state().cycle.alive
        status = HTTPStatus.OK if alive else HTTPStatus.SERVICE_UNAVAILABLE
        words = "ok\n" if alive else "the control loop completes no cycles\n"
        return Response(words, status, media_type="text/plain")


def _schema(app: FastAPI) -> dict[str, Any]:
    """Returns the OpenAPI description, with the media type of errors and the authentication scheme."""
    if app.openapi_schema is None:
        schema = FastAPI.openapi(app)
        for path in schema["paths"].values():
            for operation in path.values():
                for status, response in operation["responses"].items():
                    if int(status) >= HTTPStatus.BAD_REQUEST and "content" in response:
                        (content,) = response["content"].values()
                        response["content"] = {CONTENT_TYPE: content}
        schema["components"]["securitySchemes"] = {
            "token": {"type": "http", "scheme": "bearer", "description": "Over TCP only."}
        }
        schema["security"] = [{}, {"token": []}]
    return app.openapi_schema or {}
