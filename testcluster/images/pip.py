"""The settings with which pip reaches its index from inside a build, on machines with their own mirror or certificate.

The build receives both files as secrets, so they exist only while pip runs and leave nothing in the image.
"""

import os
import re
import ssl
import sys
from pathlib import Path

from testcluster.shell import CommandFailed, run

# Settings for reaching an index. Other settings (a target folder, a user install) are about this machine and would
# break a build.
_NETWORK = ("index-url", "extra-index-url", "trusted-host", "proxy", "timeout", "default-timeout", "retries")


def _settings() -> dict[str, str]:
    """Return pip's settings from its files and from PIP_* variables, which take precedence."""
    found: dict[str, str] = {}
    try:
        listed = run(sys.executable, "-m", "pip", "config", "list")
    except CommandFailed:
        # This Python has no pip, but its variables may be set.
        listed = ""
    for line in listed.splitlines():
        match = re.fullmatch(r"(?:global|install|:env:)\.([a-z-]+)='(.*)'", line)
        if match:
            found[match[1]] = match[2].replace("\\n", " ").strip()
    for variable, value in os.environ.items():
        if variable.startswith("PIP_"):
            found[variable.removeprefix("PIP_").lower().replace("_", "-")] = value
    return found


def _certificates() -> Path | None:
    """Return the certificate authorities that this machine trusts."""
    named = [os.environ.get(name) for name in ("PIP_CERT", "REQUESTS_CA_BUNDLE", "SSL_CERT_FILE")]
    paths = ssl.get_default_verify_paths()
    for candidate in [*named, paths.cafile, "/etc/ssl/certs/ca-certificates.crt", "/etc/pki/tls/certs/ca-bundle.crt"]:
        if candidate and Path(candidate).is_file():
            return Path(candidate)
    return None


def secrets(folder: Path) -> dict[str, Path]:
    """Write pip's configuration for a build into a folder, and return the build's secrets by name."""
    settings = _settings()
    lines = ["[global]"] + [f"{name} = {settings[name]}" for name in _NETWORK if settings.get(name)]
    certificates = _certificates()
    if certificates:
        lines.append("cert = /run/secrets/ca")
    folder.mkdir(parents=True, exist_ok=True)
    configuration = folder / "pip.conf"
    configuration.touch(mode=0o600)
    configuration.write_text("\n".join(lines) + "\n")
    return {"pip": configuration, **({"ca": certificates} if certificates else {})}
