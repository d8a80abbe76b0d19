"""Reads a kubeconfig with the official `kubernetes` package: contexts, certificates, tokens and credential plugins.

The package runs in a process of its own. It loads 45 MB of models that nothing here uses, and a credential plugin may take seconds, during
which the event loop must continue. Pods have no kubeconfig and do not need the package (extra `kubeconfig`).
"""

from __future__ import annotations

import asyncio
import json
import os
import ssl
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from understudy.kube.client import SERVICE_ACCOUNT, Access

RENEW_EARLY = 60.0
"""Seconds before its expiry at which a credential is renewed."""

PLUGIN_SECONDS = 120.0
"""Seconds that a credential plugin may take; some wait for a person in a browser."""


class KubeconfigError(ValueError):
    """A kubeconfig cannot be read, or its credential plugin gave no credential."""


@dataclass(frozen=True)
class Credentials:
    """The credentials of a kubeconfig's current context."""

    server: str
    verify: bool
    authority: str | None
    """Certificates of the API server's authorities (PEM); None for those of the system."""
    certificate: str | None
    """The client's certificate and key (PEM)."""
    token: str | None
    expires: float | None
    """When the credential expires, in unix seconds; None if the plugin does not report it."""
    plugin: bool
    """Whether a credential plugin gave it, so that it can be renewed."""

    def load_certificate(self, context: ssl.SSLContext) -> None:
        """Use the client's certificate for connections that begin from now on."""
        if self.certificate is not None:
            with tempfile.NamedTemporaryFile("w") as file:  # ssl loads chains from files only
                file.write(self.certificate)
                file.flush()
                context.load_cert_chain(file.name)


class PluginCredentials:
    """The credential of a plugin, which is asked again before the credential expires and after the API server rejected it."""

    def __init__(self, path: str | None, first: Credentials, context: ssl.SSLContext) -> None:
        self._path, self._present, self._context = path, first, context
        self._rejected = False
        self._lock = asyncio.Lock()

    async def token(self) -> str | None:
        """Return the present token; None if the plugin gives client certificates. Raises KubeconfigError."""
        async with self._lock:
            expires = self._present.expires
            if self._rejected or (expires is not None and time.time() >= expires - RENEW_EARLY):
                self._present = await asyncio.to_thread(read, self._path)
                self._present.load_certificate(self._context)
                self._rejected = False
        return self._present.token

    def reject(self) -> None:
        """Ask the plugin again for the next request: the API server answered 401."""
        self._rejected = True


def load_access(path: str | None = None) -> Access:
    """Return the access of a kubeconfig's current context; without a path, of the files that kubectl would read. Raises KubeconfigError."""
    found = read(path)
    context = ssl.create_default_context(cadata=found.authority)
    if not found.verify:
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    found.load_certificate(context)
    plugin = PluginCredentials(path, found, context) if found.plugin else None
    return Access(server=found.server, context=context, token=found.token, plugin=plugin)


def default_access() -> Access:
    """Return the access of the pod's ServiceAccount in a cluster, and that of the kubeconfig outside. Raises KubeconfigError."""
    return Access.in_cluster() if (SERVICE_ACCOUNT / "token").exists() else load_access()


def read(path: str | None = None) -> Credentials:
    """Read a kubeconfig in a process of its own; runs the credential plugin if there is one. Raises KubeconfigError."""
    command = [sys.executable, "-c", f"from {__name__} import print_credentials; print_credentials()"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    if path is not None:
        environment["KUBECONFIG"] = path
    try:
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, timeout=PLUGIN_SECONDS)
    except subprocess.TimeoutExpired as error:
        raise KubeconfigError(f"{_name(path)}: no credential within {PLUGIN_SECONDS:.0f} s") from error
    try:
        answer = json.loads(done.stdout.rpartition("\n")[2])
    except ValueError as error:
        raise KubeconfigError(f"{_name(path)} cannot be read") from error
    if "error" in answer:
        raise KubeconfigError(f"{_name(path)}: {answer['error']}")
    return Credentials(**answer)


def _name(path: str | None) -> str:
    return path or os.environ.get("KUBECONFIG") or str(Path.home() / ".kube" / "config")


def print_credentials() -> None:
    """Print the credentials of the kubeconfig as JSON, in a last line of its own: a plugin may write before it."""
    try:
        found: dict[str, object] = _official()
    except ImportError:
        found = {"error": 'the package "kubernetes" is not installed: pip install "understudy[kubeconfig]"'}
    except Exception as error:  # whatever is wrong with the file or its plugin
        found = {"error": str(error) or type(error).__name__}
    print("\n" + json.dumps(found), end="")


def _official() -> dict[str, object]:
    from kubernetes.client import Configuration
    from kubernetes.config.kube_config import KubeConfigLoader, KubeConfigMerger

    merged = KubeConfigMerger(_name(None)).config
    if merged is None:
        raise KubeconfigError("there is no such file")
    loader = KubeConfigLoader(config_dict=merged, config_base_path=None)
    configuration = Configuration()
    loader.load_and_set(configuration)
    user = loader._user.value if loader._user is not None else {}
    plugin, expiry = bool({"exec", "auth-provider", "tokenFile"} & user.keys()), getattr(loader, "expiry", None)
    token = (configuration.api_key.get("authorization") or "").removeprefix("Bearer ") or None
    if plugin and token is None and not configuration.cert_file:
        raise KubeconfigError("its credential plugin gave no credential")
    files = [file for file in (configuration.cert_file, configuration.key_file) if file]
    return {
        "server": configuration.host,
        "verify": configuration.verify_ssl,
        "authority": Path(configuration.ssl_ca_cert).read_text() if configuration.ssl_ca_cert else None,
        "certificate": "\n".join(Path(file).read_text() for file in files) or None,
        "token": token,
        "expires": expiry.timestamp() if expiry is not None else None,
        "plugin": plugin,
    }
