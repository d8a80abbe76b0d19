package nft

import (
	"encoding/binary"
	"errors"
	"fmt"
	"os"
	"runtime"
	"time"

	"golang.org/x/sys/unix"
)

// Conn is a netlink socket to the nf_tables of one network namespace. It is not for concurrent use.
type Conn struct {
	fd      int
	seq     uint32
	receive []byte
}

// Open opens a socket in the network namespace of the file, or in the process' own when netns is nil.
func Open(netns *os.File) (*Conn, error) {
	fd, err := socketIn(netns)
	if err != nil {
		return nil, fmt.Errorf("opening a netlink socket to nf_tables: %w", err)
	}
	c := &Conn{fd: fd, receive: make([]byte, 1<<17)}
	// A full replacement is one datagram. The FORCE options need CAP_NET_ADMIN, as all of this does.
	for _, option := range []int{unix.SO_SNDBUFFORCE, unix.SO_RCVBUFFORCE} {
		if err := unix.SetsockoptInt(fd, unix.SOL_SOCKET, option, 32<<20); err != nil {
			c.Close()
			return nil, fmt.Errorf("enlarging the netlink buffers: %w", err)
		}
	}
	timeout := unix.NsecToTimeval((5 * time.Second).Nanoseconds())
	if err := unix.SetsockoptTimeval(fd, unix.SOL_SOCKET, unix.SO_RCVTIMEO, &timeout); err != nil {
		c.Close()
		return nil, fmt.Errorf("setting the netlink timeout: %w", err)
	}
	return c, nil
}

func socketIn(netns *os.File) (int, error) {
	open := func() (int, error) {
		fd, err := unix.Socket(unix.AF_NETLINK, unix.SOCK_RAW|unix.SOCK_CLOEXEC, unix.NETLINK_NETFILTER)
		if err != nil {
			return -1, err
		}
		if err := unix.Bind(fd, &unix.SockaddrNetlink{Family: unix.AF_NETLINK}); err != nil {
			unix.Close(fd)
			return -1, err
		}
		return fd, nil
	}
	if netns == nil {
		return open()
	}
	type result struct {
		fd  int
		err error
	}
	done := make(chan result)
	go func() {
		runtime.LockOSThread() // never unlocked: the thread ends with the goroutine and takes the namespace with it
		if err := unix.Setns(int(netns.Fd()), unix.CLONE_NEWNET); err != nil {
			done <- result{-1, fmt.Errorf("entering %s: %w", netns.Name(), err)}
			return
		}
		fd, err := open()
		done <- result{fd, err}
	}()
	r := <-done
	return r.fd, r.err
}

// Close closes the socket; the rules stay.
func (c *Conn) Close() error { return unix.Close(c.fd) }

// Commit makes the changes of the batch in one transaction. When it returns without error, every packet that comes after
// is judged by the new rules; with an error nothing has changed.
func (c *Conn) Commit(b *Batch) error {
	if b.Empty() {
		return nil
	}
	first := c.seq + 1
	last := first + uint32(len(b.messages))
	c.seq = last + 1
	if err := unix.Sendto(c.fd, b.wire(first), 0, &unix.SockaddrNetlink{Family: unix.AF_NETLINK}); err != nil {
		return fmt.Errorf("sending %d changes to nf_tables: %w", len(b.messages), err)
	}
	var failures []error
	for {
		finished := false
		err := c.each(func(kind uint16, seq uint32, _ uint16, body []byte) {
			if seq < first || seq > last || kind != unix.NLMSG_ERROR || len(body) < 4 {
				return // an answer to an earlier batch that had failed
			}
			if errno := unix.Errno(-int32(binary.NativeEndian.Uint32(body))); errno != 0 {
				about := "the transaction"
				if seq > first {
					about = b.messages[seq-first-1].about
				}
				failures = append(failures, fmt.Errorf("%s: %w", about, errno))
			}
			finished = finished || seq == last || seq == first
		})
		if err != nil {
			return errors.Join(append(failures, fmt.Errorf("waiting for nf_tables to confirm: %w", err))...)
		}
		if finished {
			return errors.Join(failures...)
		}
	}
}

// each receives one datagram and calls f for each message in it.
func (c *Conn) each(f func(kind uint16, seq uint32, flags uint16, body []byte)) error {
	var n int
	for {
		var err error
		n, _, err = unix.Recvfrom(c.fd, c.receive, 0)
		if err == nil {
			break
		}
		if err != unix.EINTR {
			return err
		}
	}
	data := c.receive[:n]
	for len(data) >= unix.NLMSG_HDRLEN {
		length := int(binary.NativeEndian.Uint32(data))
		if length < unix.NLMSG_HDRLEN || length > len(data) {
			return errors.New("malformed netlink message")
		}
		f(binary.NativeEndian.Uint16(data[4:]), binary.NativeEndian.Uint32(data[8:]), binary.NativeEndian.Uint16(data[6:]), data[unix.NLMSG_HDRLEN:length])
		data = data[min(align4(length), len(data)):]
	}
	return nil
}
