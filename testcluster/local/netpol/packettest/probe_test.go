package packettest

import (
	"context"
	"encoding/binary"
	"errors"
	"fmt"
	"hash/crc32"
	"io"
	"math/rand/v2"
	"net"
	"net/netip"
	"strings"
	"sync"
	"syscall"
	"testing"
	"time"

	"golang.org/x/sys/unix"

	"understudy/testcluster/understudy-netpol/conformance"
)

// ports is where every host answers, by UDP and TCP.
var ports = []uint16{1, 80, 1000, 7949, 7950, 8000, 8080, 8149, 8150, 9090, 65535}

// listeners answer whatever comes, and remember it.
type listeners struct {
	mu   sync.Mutex
	got  map[string]int       // by the text of the message
	last map[string]time.Time // by the sender of a stream
	hook func(from netip.AddrPort, text string, at time.Time)
}

func listen(t testing.TB, n *namespace) *listeners {
	t.Helper()
	l := &listeners{got: map[string]int{}, last: map[string]time.Time{}}
	must(t, n.do(func() error {
		for _, port := range ports {
			conn, err := net.ListenUDP("udp", &net.UDPAddr{Port: int(port)})
			if err != nil {
				return err
			}
			t.Cleanup(func() { conn.Close() })
			go l.answerUDP(conn)
			tcp, err := net.ListenTCP("tcp", &net.TCPAddr{Port: int(port)})
			if err != nil {
				return err
			}
			t.Cleanup(func() { tcp.Close() })
			go l.answerTCP(tcp)
		}
		// The kernel has no SCTP here; policies can be tested with bare packets all the same.
		raw, err := net.ListenIP("ip4:132", &net.IPAddr{})
		if err != nil {
			return err
		}
		t.Cleanup(func() { raw.Close() })
		go l.hearSCTP(raw)
		return nil
	}))
	return l
}

func (l *listeners) note(text string) {
	l.mu.Lock()
	l.got[text]++
	l.mu.Unlock()
}

func (l *listeners) heard(text string) bool {
	l.mu.Lock()
	defer l.mu.Unlock()
	return l.got[text] > 0
}

func (l *listeners) answerUDP(conn *net.UDPConn) {
	buffer := make([]byte, 2048)
	for {
		n, from, err := conn.ReadFromUDPAddrPort(buffer)
		if err != nil {
			return
		}
		at := time.Now()
		text := string(buffer[:n])
		l.mu.Lock()
		hook := l.hook
		l.mu.Unlock()
		if hook != nil {
			hook(netip.AddrPortFrom(from.Addr().Unmap(), from.Port()), text, at)
			continue
		}
		l.note(text)
		conn.WriteToUDPAddrPort(buffer[:n], from)
	}
}

func (l *listeners) answerTCP(listener *net.TCPListener) {
	for {
		conn, err := listener.AcceptTCP()
		if err != nil {
			return
		}
		go func() {
			defer conn.Close()
			buffer := make([]byte, 2048)
			for {
				n, err := conn.Read(buffer)
				if err != nil {
					return
				}
				l.note(string(buffer[:n]))
				if _, err := conn.Write(buffer[:n]); err != nil {
					return
				}
			}
		}()
	}
}

func (l *listeners) hearSCTP(conn *net.IPConn) {
	buffer := make([]byte, 2048)
	for {
		n, _, err := conn.ReadFromIP(buffer)
		if err != nil {
			return
		}
		if n >= 32 {
			l.note(string(buffer[24:32])) // the initiate tag and window that the prober chose
		}
	}
}

// patience is how long to wait for an answer that should not come, or for one that should. The latter may take long on a
// busy machine, but the wait ends when it comes.
func patience(want bool) time.Duration {
	if want {
		return 3 * time.Second
	}
	return 150 * time.Millisecond
}

// reaches reports whether a request arrived and its answer came back. A request that arrives without its answer coming back,
// or the other way round, is an error of its own.
func (w *world) reaches(f conformance.Flow, family int, want bool) (bool, error) {
	from, to := w.hosts[f.From], w.hosts[f.To]
	target := netip.AddrPortFrom(to.addrs[family], f.Port)
	return exchange(from, to.listeners, f.Protocol, target, patience(want))
}

func exchange(from *host, to *listeners, protocol string, target netip.AddrPort, wait time.Duration) (bool, error) {
	token := fmt.Sprintf("%08x", rand.Uint32())
	switch protocol {
	case "icmp":
		return ping(from, target.Addr(), wait)
	case "sctp":
		return initiate(from, to, target, token, wait)
	}
	answered, err := ask(from, protocol, target, token, wait)
	if err != nil {
		return false, err
	}
	if arrived := to.heard(token); arrived != answered {
		return false, fmt.Errorf("%s to %s: arrived is %t, answered is %t", protocol, target, arrived, answered)
	}
	return answered, nil
}

func (h *host) dial(protocol string, target netip.AddrPort, timeout time.Duration) (conn net.Conn, err error) {
	err = h.do(func() error {
		// A context with a deadline would let the dialer use another thread.
		var inner error
		if protocol == "udp" {
			conn, inner = net.DialUDP("udp", nil, net.UDPAddrFromAddrPort(target))
			return inner
		}
		conn, inner = connectTCP(target, timeout)
		return inner
	})
	return conn, err
}

// connectTCP is net.DialTCP with a limit, all on the calling thread.
func connectTCP(target netip.AddrPort, timeout time.Duration) (net.Conn, error) {
	dialer := net.Dialer{Timeout: timeout, FallbackDelay: -1}
	return dialer.DialContext(context.Background(), "tcp", target.String())
}

func ask(from *host, protocol string, target netip.AddrPort, token string, wait time.Duration) (bool, error) {
	conn, err := from.dial(protocol, target, wait)
	if err != nil {
		if timeout := net.Error(nil); errors.As(err, &timeout) && timeout.Timeout() {
			return false, nil
		}
		return false, err
	}
	defer conn.Close()
	return request(conn, token, wait)
}

// request sends a message up to three times and waits for the same to come back.
func request(conn net.Conn, token string, wait time.Duration) (bool, error) {
	buffer := make([]byte, 2048)
	_, stream := conn.(*net.TCPConn)
	for try := range 3 {
		if try == 0 || !stream {
			if _, err := io.WriteString(conn, token); err != nil && !errors.Is(err, syscall.EPERM) && !errors.Is(err, syscall.ECONNREFUSED) {
				return false, err
			}
		}
		conn.SetReadDeadline(time.Now().Add(wait / 3))
		for {
			n, err := conn.Read(buffer)
			if err != nil {
				break
			}
			if strings.Contains(string(buffer[:n]), token) {
				return true, nil
			}
		}
	}
	return false, nil
}

func ping(from *host, to netip.Addr, wait time.Duration) (bool, error) {
	network, kind, answer := "ip4:icmp", byte(8), byte(0)
	if to.Is6() {
		network, kind, answer = "ip6:ipv6-icmp", 128, 129
	}
	var conn *net.IPConn
	err := from.do(func() (err error) {
		conn, err = net.DialIP(network, nil, &net.IPAddr{IP: to.AsSlice()})
		return err
	})
	if err != nil {
		return false, err
	}
	defer conn.Close()
	id := uint16(rand.Uint32())
	message := []byte{kind, 0, 0, 0, byte(id >> 8), byte(id), 0, 1, 'p', 'i', 'n', 'g'}
	if to.Is4() { // for IPv6 the kernel writes it
		binary.BigEndian.PutUint16(message[2:], checksum(message))
	}
	if _, err := conn.Write(message); err != nil && !errors.Is(err, syscall.EPERM) {
		return false, err
	}
	conn.SetReadDeadline(time.Now().Add(wait))
	buffer := make([]byte, 1500)
	for {
		n, _, err := conn.ReadFromIP(buffer) // without the IP header
		if err != nil {
			return false, nil
		}
		if n >= 8 && buffer[0] == answer && binary.BigEndian.Uint16(buffer[4:]) == id {
			return true, nil
		}
	}
}

func checksum(data []byte) uint16 {
	sum := uint32(0)
	for i := 0; i+1 < len(data); i += 2 {
		sum += uint32(data[i])<<8 | uint32(data[i+1])
	}
	for sum > 0xffff {
		sum = sum>>16 + sum&0xffff
	}
	return ^uint16(sum)
}

// initiate sends an SCTP INIT, which is all that a policy can be shown without an SCTP stack.
func initiate(from *host, to *listeners, target netip.AddrPort, token string, wait time.Duration) (bool, error) {
	packet := make([]byte, 32)
	binary.BigEndian.PutUint16(packet[0:], 40000+uint16(rand.Uint32N(20000)))
	binary.BigEndian.PutUint16(packet[2:], target.Port())
	packet[12] = 1 // INIT
	binary.BigEndian.PutUint16(packet[14:], 20)
	copy(packet[16:24], "\x00\x00\x00\x01\x00\x01\x00\x00")
	copy(packet[24:32], token)
	binary.LittleEndian.PutUint32(packet[8:], crc32.Checksum(packet, crc32.MakeTable(crc32.Castagnoli)))
	err := from.do(func() error {
		fd, err := unix.Socket(unix.AF_INET, unix.SOCK_RAW|unix.SOCK_CLOEXEC, 132)
		if err != nil {
			return err
		}
		defer unix.Close(fd)
		return unix.Sendto(fd, packet, 0, &unix.SockaddrInet4{Addr: target.Addr().As4()})
	})
	if err != nil {
		return false, err
	}
	for end := time.Now().Add(wait); time.Now().Before(end); time.Sleep(5 * time.Millisecond) {
		if to.heard(token) {
			return true, nil
		}
	}
	return false, nil
}
