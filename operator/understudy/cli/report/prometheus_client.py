"""What a Prometheus (or what speaks its HTTP API, such as Thanos or Mimir) answers to expressions."""

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
"""Seconds that it has to answer: it gives up by itself after two minutes."""

_LONGEST = 100_000_000
"""Bytes that an answer may have."""


class Series(NamedTuple):
    """One series of an answer."""

    labels: Mapping[str, str]
    points: Sequence[tuple[float, float]]
    """Moments (unix seconds) with their values, in order."""

    @property
    def value(self) -> float:
        """The last one."""
        return self.points[-1][1]


class Prometheus:
    """Asks one server."""

    def __init__(self, url: str, *, token_file: str | None = None, ca_file: str | None = None) -> None:
        """``url`` is what is before ``/api/v1``. Raises CommandError where it or a file can't be used."""
        parts = urllib.parse.urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname or parts.username or parts.query:
            raise CommandError(
                f"--prometheus: found {parts._replace(netloc=parts.netloc.rpartition('@')[2]).geturl()!r:.200}; write where it is "
                "served, such as http://localhost:9090 or https://monitoring.example/prometheus, with a token by "
                "--prometheus-token-file"
            )
        self.url = url.rstrip("/")
        self._token = _text("--prometheus-token-file", token_file).strip() if token_file else ""
        try:
            self._context = ssl.create_default_context(cafile=ca_file)
        except OSError as error:
            raise CommandError(f"--prometheus-ca-file: {ca_file} can't be used: {error.strerror or error}") from error

    def query(self, expression: str, at: float) -> Sequence[Series]:
        """The series of an expression at a moment. Raises CommandError."""
        found = self._ask("query", {"query": expression, "time": f"{at:.3f}"})
        return self._series(found, "value")

    def range(self, expression: str, begin: float, end: float, step: float) -> Sequence[Series]:
        """The series of an expression from one moment until another, every so many seconds. Raises CommandError."""
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
        if self._token:  # which isn't for whoever the server may send us on to
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
                f"Prometheus at {self.url} answers {status}: it wants a token; give {way} by --prometheus-token-file FILE"
            )
        try:
            told = json.loads(text)
            kind, message = str(told["errorType"]), str(told["error"])
        except (KeyError, TypeError, ValueError):
            return self._other(f" ({status})")
        way = "; name robots, or give a shorter period" if kind in ("timeout", "execution") else ""
        return CommandError(f"Prometheus at {self.url} can't tell: {message:.500}{way}")

    def _unreached(self, error: Exception) -> CommandError:
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        if isinstance(reason, ssl.SSLCertVerificationError):
            way = f"its certificate isn't trusted ({reason.verify_message}); give its authority's by --prometheus-ca-file FILE"
            return CommandError(f"Prometheus at {self.url}: {way}")
        if isinstance(reason, TimeoutError):
            way = f"it had not answered after {TIMEOUT:g} s; name robots, or give a shorter period"
            return CommandError(f"Prometheus at {self.url}: {way}")
        said = (reason.strerror if isinstance(reason, OSError) else None) or str(reason)
        return CommandError(
            f"Prometheus at {self.url} can't be reached: {said}; one in the cluster is brought here by kubectl port-forward, such as "
            "kubectl port-forward -n monitoring service/prometheus-operated 9090, and then --prometheus http://localhost:9090"
        )

    def _other(self, more: str = "") -> CommandError:
        return CommandError(
            f"what answers at {self.url} isn't a Prometheus{more}: give the address before /api/v1, as a browser would open it"
        )


def _text(option: str, path: str) -> str:
    try:
        return Path(path).read_text()
    except (OSError, UnicodeDecodeError) as error:
        told = error.strerror if isinstance(error, OSError) else error
        raise CommandError(f"{option}: {path} can't be read: {told}") from error
