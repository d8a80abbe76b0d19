"""Health, readiness and metrics over HTTP."""

from __future__ import annotations

from collections.abc import Callable

from aiohttp import web
from prometheus_client import generate_latest

from understudy.controller.reconcile.operator_metrics import REGISTRY

Check = Callable[[], str | None]
"""Returns the problem of a check, or None if there is none."""


async def serve(port: int, *, alive: Check, ready: Check) -> web.AppRunner:
    """Serve /healthz, /ready and /metrics, and return the runner, which the caller must clean up.

    Port 0 takes any free port.
    """

    def page(check: Check) -> Callable[[web.Request], object]:
        async def answer(_: web.Request) -> web.Response:
            words = check()
            return web.Response(text=words or "ok", status=503 if words else 200)

        return answer

    async def metrics(_: web.Request) -> web.Response:
        return web.Response(body=generate_latest(REGISTRY), headers={"Content-Type": "text/plain; version=0.0.4"})

    app = web.Application()
    app.router.add_get("/healthz", page(alive))  # type: ignore[arg-type]
    app.router.add_get("/ready", page(ready))  # type: ignore[arg-type]
    app.router.add_get("/metrics", metrics)
    runner = web.AppRunner(app, access_log=None)
    await runner.setup()
    await web.TCPSite(runner, port=port).start()
    return runner
