package packettest

import (
	"fmt"
	"os"
	"os/exec"
	"path/filepath"
	"runtime"
	"strings"
	"testing"

	"golang.org/x/sys/unix"
)

// namespace is a network namespace, held by a file. Never a named one of `ip netns`: that mounts over /run/netns, which
// breaks every container runtime of the machine that has its own mounts there.
type namespace struct {
	path string
	file *os.File
}

func newNamespace(t testing.TB, directory, name string) *namespace {
	t.Helper()
	path := filepath.Join(directory, name)
	if err := os.WriteFile(path, nil, 0o600); err != nil {
		t.Fatal(err)
	}
	if out, err := exec.Command("unshare", "--net="+path, "true").CombinedOutput(); err != nil {
		t.Fatalf("unshare --net=%s: %v %s", path, err, out)
	}
	t.Cleanup(func() { unix.Unmount(path, unix.MNT_DETACH) })
	file, err := os.Open(path)
	if err != nil {
		t.Fatal(err)
	}
	t.Cleanup(func() { file.Close() })
	n := &namespace{path, file}
	// Otherwise IPv6 does nothing for a second or two, until every interface is sure of its address.
	n.sysctl(t, "ipv6/conf/all/accept_dad=0", "ipv6/conf/default/accept_dad=0")
	return n
}

// run runs a command in the namespace, with a text on its input.
func (n *namespace) run(t testing.TB, input string, command ...string) string {
	t.Helper()
	cmd := exec.Command("nsenter", append([]string{"--net=" + n.path}, command...)...)
	cmd.Stdin = strings.NewReader(input)
	out, err := cmd.CombinedOutput()
	if err != nil {
		t.Fatalf("%s: %v\n%s", strings.Join(command, " "), err, out)
	}
	return string(out)
}

// ip runs lines of ip commands.
func (n *namespace) ip(t testing.TB, lines ...string) {
	t.Helper()
	n.run(t, strings.Join(lines, "\n")+"\n", "ip", "-batch", "-")
}

// sysctl sets values below /proc/sys/net, given as "ipv4/ip_forward=1".
func (n *namespace) sysctl(t testing.TB, values ...string) {
	t.Helper()
	must(t, n.do(func() error {
		for _, setting := range values {
			name, value, _ := strings.Cut(setting, "=")
			if err := os.WriteFile("/proc/sys/net/"+name, []byte(value), 0o644); err != nil {
				return err
			}
		}
		return nil
	}))
}

// do calls f on a thread inside the namespace. Sockets that f opens stay there.
func (n *namespace) do(f func() error) error {
	done := make(chan error)
	go func() {
		runtime.LockOSThread() // never unlocked: the thread ends with the goroutine
		if err := unix.Setns(int(n.file.Fd()), unix.CLONE_NEWNET); err != nil {
			done <- fmt.Errorf("entering %s: %w", n.path, err)
			return
		}
		done <- f()
	}()
	return <-done
}
