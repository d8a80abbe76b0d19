#!/usr/bin/env bash
# Tests the enforcer: `go vet`, then the meaning of policies with the pure model, then packets in network namespaces (as root; skipped
# with a message if no namespace can be made). Takes about 40 s. Arguments go to `go test`, such as -v or -run NAME.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"
# nft, ip and unshare are not on the path of every user; Go may have been installed by scripts/cluster.
cache=${XDG_CACHE_HOME:-$HOME/.cache}/understudy
export PATH=$PATH:/usr/sbin:/sbin:/usr/local/go/bin:/usr/lib/go/bin:$cache/go/bin
export CGO_ENABLED=0 GOFLAGS="-mod=readonly -trimpath -buildvcs=false" GOWORK=off
command -v go >/dev/null || {
    echo "$0: there is no Go compiler (1.24 or newer): scripts/cluster up installs one" >&2
    exit 1
}
nice -n 5 go vet ./...
exec nice -n 5 go test -timeout 180s ./... "$@"
