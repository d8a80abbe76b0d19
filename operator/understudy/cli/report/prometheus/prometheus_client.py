"""Queries a Prometheus, or another server with its HTTP API such as Thanos or Mimir."""

from __future__ import annotations

import json
import ssl
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping, Sequence
from http.client import HTTPException
from pathlib import Path
from typing import Any, NamedTuple

from understudy.cli.common.errors import CommandError

TIMEOUT = 130.0
"""Seconds to wait for an answer: the server itself gives up after two minutes."""

_LONGEST = 100_000_000
"""Most bytes of an answer."""


class Series(NamedTuple):
    """One time series of an answer."""

    labels: Mapping[str, str]
    points: Sequence[tuple[float, float]]
    """Times (unix seconds) with values, in order."""

    @property
    def value(self) -> float:
        """The last value."""
        return self.points[-1][1]


class Prometheus:
    """Queries one server."""

    def __init__(self, url: str, *, token_file: str | None = None, ca_file: str | None = None) -> None:
        """``url`` is the address before ``/api/v1``. Raises CommandError if it or a file is not usable."""
        parts = urllib.parse.urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname or parts.username or parts.query:
            raise CommandError(
                f"--prometheus: found {parts._replace(netloc=parts.netloc.rpartition('@')[2]).geturl()!r:.200}; give its address, "
                "such as http://localhost:9090 or https://monitoring.example/prometheus, and a token with "
                "--prometheus-token-file"
            )
        self.url = url.rstrip("/")
        self._token = _text("--prometheus-token-file", token_file).strip() if token_file else ""
        try:
            self._context = ssl.create_default_context(cafile=ca_file)
        except OSError as error:
            raise CommandError(f"--prometheus-ca-file: {ca_file} cannot be used: {error.strerror or error}") from error

    def query(self, expression: str, at: float) -> Sequence[Series]:
        """Return the series of an expression at a time. Raises CommandError."""
        found = self._ask("query", {"query": expression, "time": f"{at:.3f}"})
        return self._series(found, "value")

    def range(self, expression: str, begin: float, end: float, step: float) -> Sequence[Series]:
        """Return the series of an expression over an interval, with a step in seconds. Raises CommandError."""
        asked = {"query": expression, "start": f"{begin:.3f}", "end": f"{end:.3f}", "step": f"{step:.3f}"}
        return self._series(self._ask("query_range", asked), "values")

    def _series(self, found: Any, key: str) -> Sequence[Series]:
        try:
            return [
                Series(
                    one["metric"],
                    [(float(at), float(value)) for at, value in ([one[key]] if key == "value" else one[key])],
                )
                for one in found["result"]
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise self._other() from error

    def _ask(self, page: str, asked: Mapping[str, str]) -> Any:
        request = urllib.request.Request(f"{self.url}/api/v1/{page}?{urllib.parse.urlencode(asked)}")
        if self._token:  # not for the target of a redirect
            request.add_unredirected_header("Authorization", f"Bearer {self._token}")
        try:
            with urllib.request.urlopen(request, timeout=TIMEOUT, context=self._context) as answer:
                text = answer.read(_LONGEST)
        except urllib.error.HTTPError as error:
            with error:
                raise self._refused(error.code, error.read(_LONGEST)) from error
        except (OSError, HTTPException, ValueError) as error:
            raise self._unreached(error) from error
        try:
            return json.loads(text)["data"]
        except (KeyError, TypeError, ValueError) as error:
            raise self._other() from error

    def _refused(self, status: int, text: bytes) -> CommandError:
        if status in (401, 403):
            way = "another one" if self._token else "one"
            return CommandError(
                f"Prometheus at {self.url} answers {status}: it requires a token; give {way} with --prometheus-token-file FILE"
            )
        try:
            told = json.loads(text)
            kind, message = str(told["errorType"]), str(told["error"])
        except (KeyError, TypeError, ValueError):
            return self._other(f" ({status})")
        way = "; name robots, or choose a shorter period" if kind in ("timeout", "execution") else ""
        return CommandError(f"Prometheus at {self.url} reports an error: {message:.500}{way}")

    def _unreached(self, error: Exception) -> CommandError:
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        if isinstance(reason, ssl.SSLCertVerificationError):
            way = f"its certificate is not trusted ({reason.verify_message}); give its certificate authority with --prometheus-ca-file FILE"
            return CommandError(f"Prometheus at {self.url}: {way}")
        if isinstance(reason, TimeoutError):
            way = f"it had not answered after {TIMEOUT:g} s; name robots, or choose a shorter period"
            return CommandError(f"Prometheus at {self.url}: {way}")
        said = (reason.strerror if isinstance(reason, OSError) else None) or str(reason)
        return CommandError(
            f"Prometheus at {self.url} cannot be reached: {said}; to use one in the cluster, forward its port, such as "
            "kubectl port-forward -n monitoring service/prometheus-operated 9090, and then --prometheus http://localhost:9090"
        )

    def _other(self, more: str = "") -> CommandError:
        return CommandError(
            f"the server at {self.url} is not a Prometheus{more}: give the address before /api/v1, as in a browser"
        )


def _text(option: str, path: str) -> str:
    try:
        return Path(path).read_text()
    except (OSError, UnicodeDecodeError) as error:
        told = error.strerror if isinstance(error, OSError) else error
        raise CommandError(f"{option}: {path} cannot be read: {told}") from error
