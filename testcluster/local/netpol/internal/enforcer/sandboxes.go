package enforcer

import (
	"context"
	"encoding/binary"
	"encoding/json"
	"fmt"
	"io/fs"
	"log/slog"
	"net/netip"
	"os"
	"path/filepath"
	"strings"
	"time"

	"golang.org/x/sys/unix"

	"understudy/testcluster/understudy-netpol/internal/policy"
)

// sandboxes watches the directory where libcni keeps the result of every ADD until the DEL (/var/lib/cni/results). A pod's
// address is there before its first container starts, and status.podIPs follows about a second later. Packets of unknown
// addresses are dropped, so without this watch a new pod would be cut off for that second.
type sandboxes struct {
	directory string
	queue     *queue
}

// cniResult holds the needed fields of libcni's cache file (kind cniCacheV1).
type cniResult struct {
	IfName  string      `json:"ifName"`
	CNIArgs [][2]string `json:"cniArgs"`
	Result  struct {
		IPs []struct {
			Address string `json:"address"`
		} `json:"ips"`
	} `json:"result"`
}

// start begins to watch, and reads the files that are there.
func (s *sandboxes) start(ctx context.Context) error {
	if err := os.MkdirAll(s.directory, 0o700); err != nil {
		return fmt.Errorf("directory of CNI results: %w", err)
	}
	// The watch first, so that no file that comes after the list is missed.
	file, watchErr := s.watch()
	known := map[string]bool{}
	if err := s.list(known, true); err != nil {
		if file != nil {
			file.Close()
		}
		return err
	}
	if watchErr != nil {
		slog.Warn("looking at CNI results ten times a second instead of watching them", "error", watchErr.Error())
		go s.poll(ctx, known)
		return nil
	}
	context.AfterFunc(ctx, func() { file.Close() })
	go s.follow(file, known)
	return nil
}

// watch fails if the machine's inotify instances (128 per user, by default) are used up.
func (s *sandboxes) watch() (*os.File, error) {
	fd, err := unix.InotifyInit1(unix.IN_CLOEXEC | unix.IN_NONBLOCK)
	if err != nil {
		return nil, fmt.Errorf("inotify: %w", err)
	}
	if _, err := unix.InotifyAddWatch(fd, s.directory, unix.IN_CLOSE_WRITE|unix.IN_MOVED_TO|unix.IN_DELETE|unix.IN_MOVED_FROM); err != nil {
		unix.Close(fd)
		return nil, fmt.Errorf("watching %s: %w", s.directory, err)
	}
	return os.NewFile(uintptr(fd), "inotify"), nil // non-blocking, so that closing it ends a read
}

func (s *sandboxes) poll(ctx context.Context, known map[string]bool) {
	for ctx.Err() == nil {
		sleep(ctx, 100*time.Millisecond)
		if err := s.list(known, false); err != nil {
			slog.Error("looking at CNI results", "error", err.Error())
		}
	}
}

// list reads the files that are new, or all files if again is true, and forgets known files that are gone.
func (s *sandboxes) list(known map[string]bool, again bool) error {
	entries, err := os.ReadDir(s.directory)
	if err != nil {
		return fmt.Errorf("directory of CNI results: %w", err)
	}
	present := map[string]bool{}
	for _, entry := range entries {
		present[entry.Name()] = true
		if again || !known[entry.Name()] {
			s.read(entry.Name(), known)
		}
	}
	for name := range known {
		if !present[name] {
			s.forget(name, known)
		}
	}
	return nil
}

func (s *sandboxes) follow(file *os.File, known map[string]bool) {
	buffer := make([]byte, 64<<10)
	for {
		n, err := file.Read(buffer)
		if err != nil {
			return // closed
		}
		for data := buffer[:n]; len(data) >= unix.SizeofInotifyEvent; {
			mask := binary.NativeEndian.Uint32(data[4:])
			length := unix.SizeofInotifyEvent + int(binary.NativeEndian.Uint32(data[12:]))
			name := strings.TrimRight(string(data[unix.SizeofInotifyEvent:length]), "\x00")
			data = data[length:]
			switch {
			case mask&unix.IN_Q_OVERFLOW != 0:
				if err := s.list(known, true); err != nil {
					slog.Error("reading CNI results again", "error", err.Error())
				}
			case mask&(unix.IN_DELETE|unix.IN_MOVED_FROM) != 0:
				s.forget(name, known)
			default:
				s.read(name, known)
			}
		}
	}
}

func (s *sandboxes) forget(name string, known map[string]bool) {
	if !known[name] {
		return
	}
	delete(known, name)
	s.queue.put(change{cause: Cause{Kind: "Sandbox", Name: name, Event: "delete"}, received: time.Now(),
		apply: func(x *policy.Index) (bool, []error) { return x.DeleteSandbox(name), nil }})
}

func (s *sandboxes) read(name string, known map[string]bool) {
	received := time.Now()
	path := filepath.Join(s.directory, name)
	data, err := os.ReadFile(path)
	if err != nil {
		if !os.IsNotExist(err) { // it may be gone already
			slog.Warn("reading a CNI result", "file", path, "error", err.Error())
		}
		return
	}
	sandbox, ok := parseSandbox(data)
	if !ok {
		return
	}
	sandbox.Created = modified(path, received)
	known[name] = true
	s.queue.put(change{cause: Cause{Kind: "Sandbox", Namespace: sandbox.Pod.Namespace, Name: sandbox.Pod.Name, Event: "set"}, received: received,
		apply: func(x *policy.Index) (bool, []error) { x.SetSandbox(name, sandbox); return true, nil }})
}

func modified(path string, otherwise time.Time) time.Time {
	var info fs.FileInfo
	var err error
	if info, err = os.Stat(path); err != nil {
		return otherwise
	}
	return info.ModTime()
}

// parseSandbox returns false if the file is not a pod's network (the loopback's result) or is not yet complete.
func parseSandbox(data []byte) (policy.Sandbox, bool) {
	var result cniResult
	if json.Unmarshal(data, &result) != nil {
		return policy.Sandbox{}, false
	}
	var sandbox policy.Sandbox
	for _, arg := range result.CNIArgs {
		switch arg[0] {
		case "K8S_POD_NAMESPACE":
			sandbox.Pod.Namespace = arg[1]
		case "K8S_POD_NAME":
			sandbox.Pod.Name = arg[1]
		case "K8S_POD_UID":
			sandbox.UID = arg[1]
		}
	}
	for _, ip := range result.Result.IPs {
		if prefix, err := netip.ParsePrefix(ip.Address); err == nil && !prefix.Addr().IsLoopback() {
			sandbox.Addrs = append(sandbox.Addrs, prefix.Addr().Unmap())
		}
	}
	return sandbox, sandbox.Pod.Name != "" && len(sandbox.Addrs) > 0
}
