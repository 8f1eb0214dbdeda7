"""The page's routes. What changes nothing is GET; what changes settings or works on recordings is POST or DELETE.

There is no route that arms, changes the mode or moves the vehicle, and the parts below have no way to the links.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, Final

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp
from starlette.websockets import WebSocket

from companion.errors import CompanionError
from companion.web.assets import Asset, load_assets
from companion.web.guard import Guard
from companion.web.pictures import jpeg_of
from companion.web.security import COOKIE, SESSION_S, Gate, headers_of
from companion.web.settings import SettingsDesk
from companion.web.studio import Studio
from companion.web.viewers import Viewers

API: Final = 1
"""Number of the API; it changes when a program that reads it would have to."""

Handler = Callable[[Request], Awaitable[Response]]


@dataclass(frozen=True, slots=True)
class Parts:
    """What the page is made of.

    Attributes
    ----------
    gate
        Decides who may ask.
    viewers
        The live part; None where recordings are looked at without a service.
    settings
        Of the service, or of the file.
    studio
        Recordings.
    """

    gate: Gate
    viewers: Viewers | None
    settings: SettingsDesk
    studio: Studio


def make_application(parts: Parts) -> ASGIApp:
    """Return the application, guarded."""
    pages = _Pages(parts)
    routes = [
        Route("/", pages.index, methods=["GET"]),
        Route("/static/{name}", pages.asset, methods=["GET"]),
        Route("/api/session", pages.session, methods=["GET"]),
        Route("/api/login", pages.login, methods=["POST"]),
        Route("/api/state", pages.state, methods=["GET"]),
        Route("/api/picture.jpg", pages.picture, methods=["GET"]),
        Route("/api/settings", pages.settings, methods=["GET"]),
        Route("/api/settings/apply", pages.apply, methods=["POST"]),
        Route("/api/settings/undo", pages.undo, methods=["POST"]),
        Route("/api/settings/save", pages.save, methods=["POST"]),
        Route("/api/recordings", pages.recordings, methods=["GET"]),
        Route("/api/recordings/{recording}", pages.recording, methods=["GET"]),
        Route(
            "/api/recordings/{recording}/pictures/{number:int}.jpg", pages.recorded_picture, methods=["GET"]
        ),
        Route("/api/comparisons", pages.compare, methods=["POST"]),
        Route("/api/comparisons/{number:int}", pages.comparison, methods=["GET"]),
        Route("/api/comparisons/{number:int}", pages.end_comparison, methods=["DELETE"]),
        WebSocketRoute("/api/live", pages.live),
    ]

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        yield
        await parts.studio.close()

    application = Starlette(
        routes=routes,
        lifespan=lifespan,
        exception_handlers={HTTPException: _on_http_error, CompanionError: _on_companion_error},
    )
    return Guard(application, parts.gate)


class _Pages:
    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self._assets = load_assets()

    async def index(self, request: Request) -> Response:
        return _asset_response(self._assets["index.html"], request)

    async def asset(self, request: Request) -> Response:
        asset = self._assets.get(request.path_params["name"])
        if asset is None:
            raise HTTPException(404, "no such file")
        return _asset_response(asset, request)

    async def session(self, request: Request) -> Response:
        gate = self._parts.gate
        return JSONResponse(
            {
                "api": API,
                "token_needed": not gate.has_session(headers_of(request.headers.raw), time.monotonic()),
                "live": self._parts.viewers is not None,
            }
        )

    async def login(self, request: Request) -> Response:
        match await _json(request):
            case {"token": str(token)}:
                pass
            case _:
                raise HTTPException(400, 'expected {"token": "..."}')
        now_s = time.monotonic()
        refusal = self._parts.gate.check_token(token, now_s)
        if refusal is not None:
            raise HTTPException(refusal.status, refusal.reason)
        response = JSONResponse({"token_needed": False})
        response.set_cookie(
            COOKIE, self._parts.gate.new_session(now_s), max_age=SESSION_S, httponly=True, samesite="strict"
        )
        return response

    async def state(self, _: Request) -> Response:
        return JSONResponse(self._live().snapshot())

    async def picture(self, _: Request) -> Response:
        newest = self._live().newest_picture
        if newest is None:
            raise HTTPException(404, "no picture yet: pictures are taken while somebody looks")
        return Response(jpeg_of(newest), media_type="image/jpeg")

    async def live(self, socket: WebSocket) -> None:
        if self._parts.viewers is None:
            await socket.close(1008)
            return
        await self._parts.viewers.serve(socket)

    async def settings(self, _: Request) -> Response:
        return JSONResponse(await self._parts.settings.form())

    async def apply(self, request: Request) -> Response:
        match await _json(request):
            case {"values": dict(values)} if all(isinstance(key, str) for key in values):
                return JSONResponse(await self._parts.settings.apply(values))
            case _:
                raise HTTPException(400, 'expected {"values": {"guidance.agree_deg": 12.0}}')

    async def undo(self, _: Request) -> Response:
        return JSONResponse(await self._parts.settings.undo())

    async def save(self, request: Request) -> Response:
        match await _json(request):
            case {"values": dict(values), "revision": str(revision), **rest}:
                only_look = rest.get("only_look") is True
                return JSONResponse(
                    await self._parts.settings.save(values, revision=revision, only_look=only_look)
                )
            case _:
                raise HTTPException(
                    400, 'expected {"values": {...}, "revision": "..."}, and may be "only_look": true'
                )

    async def recordings(self, _: Request) -> Response:
        return JSONResponse({"recordings": await self._parts.studio.recordings()})

    async def recording(self, request: Request) -> Response:
        return JSONResponse(await self._parts.studio.about(request.path_params["recording"]))

    async def recorded_picture(self, request: Request) -> Response:
        number = request.path_params["number"]
        picture = await self._parts.studio.picture(request.path_params["recording"], number)
        return Response(picture, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=60"})

    async def compare(self, request: Request) -> Response:
        match await _json(request):
            case {
                "recording": str(recording),
                "first": int(first),
                "last": int(last),
                "settings": [*settings],
            } if 1 <= len(settings) <= 2 and all(isinstance(values, dict) for values in settings):
                return JSONResponse(await self._parts.studio.compare(recording, first, last, settings), 201)
            case _:
                raise HTTPException(
                    400, 'expected {"recording": ..., "first": 0, "last": 99, "settings": [{}, {...}]}'
                )

    async def comparison(self, request: Request) -> Response:
        after = request.query_params.get("after", "0")
        if not (after.isascii() and after.isdecimal() and len(after) < 10):
            raise HTTPException(400, "after: expected a whole number")
        found: dict[str, Any] = self._parts.studio.comparison(request.path_params["number"], int(after))
        return JSONResponse(found)

    async def end_comparison(self, request: Request) -> Response:
        await self._parts.studio.end_comparison(request.path_params["number"])
        return JSONResponse({})

    def _live(self) -> Viewers:
        if self._parts.viewers is None:
            raise HTTPException(404, "there is no running service behind this page")
        return self._parts.viewers


async def _json(request: Request) -> Any:
    try:
        return await request.json()
    except (ValueError, RecursionError) as error:
        raise HTTPException(400, "the body is no JSON") from error
    except ClientDisconnect as error:
        raise HTTPException(413, "the body is too long, or was cut off") from error


def _asset_response(asset: Asset, request: Request) -> Response:
    headers = {"ETag": asset.etag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
    if request.headers.get("if-none-match") == asset.etag:
        return Response(status_code=304, headers=headers)
    data = asset.data
    if "gzip" in request.headers.get("accept-encoding", ""):
        data, headers["Content-Encoding"] = asset.packed, "gzip"
    return Response(data, media_type=asset.media_type, headers=headers)


async def _on_http_error(_: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    return JSONResponse({"error": error.detail}, error.status_code, headers=error.headers)


async def _on_companion_error(_: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, 409)
