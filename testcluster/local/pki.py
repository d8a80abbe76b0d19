"""Keys, certificates and kubeconfigs of a cluster. They are made once per cluster and removed with it."""

import base64
from collections.abc import Mapping
from pathlib import Path

from testcluster import atomic
from testcluster.local.layout import Layout, node_name
from testcluster.shell import run

_DAYS = "3650"
_KEY = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]

# user (also the file name): the subject from which Kubernetes reads the user and its groups
_CLIENTS = {
    "admin": "/O=system:masters/CN=understudy-admin",
    "apiserver-kubelet-client": "/O=system:masters/CN=apiserver-kubelet-client",
    "controller-manager": "/CN=system:kube-controller-manager",
    "scheduler": "/CN=system:kube-scheduler",
    "proxy": "/CN=system:kube-proxy",
}


def _certificate(folder: Path, name: str, subject: str, alternative: str = "") -> None:
    run("openssl", "req", *_KEY, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", subject, cwd=folder)
    extensions = folder / f"{name}.ext"
    extensions.write_text(
        "extendedKeyUsage=serverAuth,clientAuth\n" + (f"subjectAltName={alternative}\n" if alternative else "")
    )
    run(
        "openssl",
        "x509",
        "-req",
        "-in",
        f"{name}.csr",
        "-CA",
        "ca.crt",
        "-CAkey",
        "ca.key",
        "-days",
        _DAYS,
        "-out",
        f"{name}.crt",
        "-extfile",
        extensions.name,
        cwd=folder,
    )
    (folder / f"{name}.csr").unlink()
    extensions.unlink()


def _kubeconfig(folder: Path, name: str, cluster: str, api: str) -> None:
    def inline(file: str) -> str:
        return base64.b64encode((folder / file).read_bytes()).decode()

    path = folder / f"{name}.conf"
    path.touch(mode=0o600)
    path.write_text(f"""apiVersion: v1
kind: Config
clusters:
- name: {cluster}
  cluster: {{server: "{api}", certificate-authority-data: {inline("ca.crt")}}}
users:
- name: {cluster}-{name}
  user: {{client-certificate-data: {inline(f"{name}.crt")}, client-key-data: {inline(f"{name}.key")}}}
contexts:
- name: {cluster}
  context: {{cluster: {cluster}, user: {cluster}-{name}}}
current-context: {cluster}
""")


def create(layout: Layout, further: Mapping[str, str]) -> Path:
    """Make all keys, certificates and kubeconfigs unless they exist, and return their folder.

    ``further`` are the subjects of further clients, by name.
    """
    final = layout.state / "pki"
    if final.exists():
        return final
    with atomic.folder(final) as folder:
        _write(layout, folder, {**_CLIENTS, **further})
    return final


def _write(layout: Layout, folder: Path, clients: Mapping[str, str]) -> None:
    cluster = layout.name
    run(
        "openssl",
        "req",
        "-x509",
        *_KEY,
        "-keyout",
        "ca.key",
        "-out",
        "ca.crt",
        "-days",
        _DAYS,
        "-subj",
        f"/CN={cluster}-ca",
        cwd=folder,
    )
    names = [
        "kubernetes",
        "kubernetes.default",
        "kubernetes.default.svc",
        "kubernetes.default.svc.cluster.local",
        "localhost",
    ]
    addresses = ["127.0.0.1", layout.control_plane_ip, layout.kubernetes_ip]
    alternative = ",".join([f"DNS:{name}" for name in names] + [f"IP:{address}" for address in addresses])
    _certificate(folder, "apiserver", "/CN=kube-apiserver", alternative)
    for name, subject in clients.items():
        _certificate(folder, name, subject)
        _kubeconfig(folder, name, cluster, layout.api)
    for node in layout.nodes:
        name = node_name(node)
        _certificate(folder, name, f"/O=system:nodes/CN=system:node:{name}", f"DNS:{name},IP:{layout.node_ip(node)}")
        _kubeconfig(folder, name, cluster, layout.api)
    run("openssl", "genrsa", "-out", "service-accounts.key", "2048", cwd=folder)
    run("openssl", "rsa", "-in", "service-accounts.key", "-pubout", "-out", "service-accounts.pub", cwd=folder)
