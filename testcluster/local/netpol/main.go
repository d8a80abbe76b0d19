// Command understudy-netpol enforces NetworkPolicies for the pods of one node. Run it in the node's network namespace.
package main

import (
	"context"
	"errors"
	"flag"
	"fmt"
	"log/slog"
	"net"
	"net/http"
	"os"
	"os/signal"
	"path/filepath"
	"strconv"
	"syscall"
	"time"

	"golang.org/x/sys/unix"
	"k8s.io/client-go/tools/clientcmd"
	"k8s.io/klog/v2"

	"understudy/testcluster/understudy-netpol/internal/enforcer"
)

const slice = 100_000 // nanoseconds; the kernel allows no shorter ones

func main() {
	kubeconfig := flag.String("kubeconfig", "", "kubeconfig `FILE` of a user who may get, list and watch pods, namespaces and networkpolicies")
	node := flag.String("node", "", "`NAME` of the node whose pods are enforced")
	metrics := flag.String("metrics", "", "`ADDRESS` (host:port) to serve /metrics and /readyz at")
	interfaces := flag.String("pod-interfaces", "veth", "`PREFIX` of the host's interfaces to pods; traffic of unknown pods through them is dropped; empty: it passes")
	results := flag.String("cni-results", "/var/lib/cni/results", "`DIRECTORY` where libcni keeps results; empty: pods' addresses come from their status alone")
	reconcile := flag.Duration("reconcile", 30*time.Second, "how often the kernel's table is compared and repaired")
	priority := flag.Int("nice", -10, "scheduling priority of this process")
	// Beside the program as it was called, and no argument of it: a running node exchanges the program, and goes on calling it as before.
	beside := filepath.Join(filepath.Dir(os.Args[0]), "network-modes.json")
	modes := flag.String("modes", beside, "`FILE` with modes of weak networks as JSON, which is followed; the answer is in FILE.applied")
	cleanup := flag.Bool("cleanup", false, "remove the rules and exit")
	flag.Parse()
	slog.SetDefault(slog.New(slog.NewJSONHandler(os.Stderr, nil)))
	klog.SetSlogLogger(slog.Default()) // what client-go says

	err := func() error {
		if *cleanup {
			return enforcer.Cleanup(nil)
		}
		if *kubeconfig == "" || *node == "" || flag.NArg() > 0 {
			return errors.New("usage: understudy-netpol --kubeconfig FILE --node NAME [--metrics ADDRESS], or --cleanup; see --help")
		}
		if err := hurry(*priority); err != nil {
			slog.Warn("keeping the usual scheduling priority", "error", err.Error())
		}
		api, err := connect(*kubeconfig)
		if err != nil {
			return err
		}
		return run(api, *metrics, enforcer.Options{Node: *node, PodInterfaces: *interfaces, CNIResults: *results, Reconcile: *reconcile, Modes: *modes})
	}()
	if err != nil {
		slog.Error(err.Error())
		os.Exit(1)
	}
}

func run(api enforcer.API, metrics string, options enforcer.Options) error {
	ctx, stop := signal.NotifyContext(context.Background(), syscall.SIGTERM, syscall.SIGINT)
	defer stop()
	report := enforcer.NewReport()
	if metrics != "" {
		mux := http.NewServeMux()
		mux.Handle("/metrics", report)
		mux.Handle("/readyz", http.HandlerFunc(report.Ready))
		server := &http.Server{Addr: metrics, Handler: mux, ReadHeaderTimeout: 5 * time.Second}
		go func() {
			if err := server.ListenAndServe(); !errors.Is(err, http.ErrServerClosed) {
				slog.Error("metrics are not served", "error", err.Error())
			}
		}()
		defer server.Close()
	}
	slog.Info("starting; rules of an earlier run stay in force until all objects are listed", "node", options.Node)
	err := enforcer.New(options, report).Run(ctx, api)
	slog.Info("stopped; the rules stay in force, --cleanup removes them")
	return err
}

func connect(kubeconfig string) (enforcer.API, error) {
	// A connection whose other end has silently gone (a node's link cut) must not stay quiet for 45 seconds.
	for name, seconds := range map[string]string{"HTTP2_READ_IDLE_TIMEOUT_SECONDS": "3", "HTTP2_PING_TIMEOUT_SECONDS": "2"} {
		if os.Getenv(name) == "" {
			os.Setenv(name, seconds)
		}
	}
	config, err := clientcmd.BuildConfigFromFlags("", kubeconfig)
	if err != nil {
		return enforcer.API{}, fmt.Errorf("kubeconfig %s: %w", kubeconfig, err)
	}
	config.UserAgent = "understudy-netpol"
	config.Dial = (&net.Dialer{Timeout: 3 * time.Second, KeepAlive: 30 * time.Second}).DialContext // for the same reason
	api, err := enforcer.Connect(config)
	if err != nil {
		return enforcer.API{}, fmt.Errorf("kubeconfig %s: %w", kubeconfig, err)
	}
	return api, nil
}

// hurry sets the priority of every thread there is, and short time slices, which the kernel lets go before a thread that
// is running (EEVDF, from Linux 6.12 on; older kernels take no notice). Threads to come inherit both.
func hurry(priority int) error {
	threads, err := os.ReadDir("/proc/self/task")
	if err != nil {
		return err
	}
	wanted := unix.SchedAttr{Size: unix.SizeofSchedAttr, Policy: unix.SCHED_NORMAL, Nice: int32(priority), Runtime: slice}
	for _, thread := range threads {
		id, err := strconv.Atoi(thread.Name())
		if err != nil {
			return err
		}
		if err := unix.SchedSetAttr(id, &wanted, 0); err != nil && !errors.Is(err, unix.ESRCH) {
			return fmt.Errorf("priority %d: %w", priority, err)
		}
	}
	return nil
}
