"""Runs in the application's container, by its interpreter: imports modules while the pod is held, and then is the application.

The application's imports are most of what it takes Python to start. This process does them before anybody knows for which robot, waits for
the claim, and runs the application's command in itself: with its arguments, its environment, its process id and an empty ``__main__``.
Further Python processes that the application starts are forked from it, and run like ones that were just started, with these modules.

A command that cannot be run in this way is executed as usual, and only loses the preparation: another interpreter, options other than
``-u``, variables that an interpreter reads at its start (``PYTHON*``, ``LD_*``), and for further processes, threads or modules of C that
would have to be loaded twice.

The agent copies this file into the pod's shared volume, so it imports nothing but the standard library.

    python3 preloaded_interpreter.py DIRECTORY CONTAINER SKIP MODULES COMMAND...

SKIP is how many words of COMMAND come before the application's own (``understudy.api.protocol.freeze_script``).
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import importlib
import io
import os
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import traceback
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.machinery import ExtensionFileLoader
from pathlib import Path
from typing import Any, NoReturn

_READ_AT_START = ("PYTHON", "LD_")
"""Beginnings of the names of variables that an interpreter, or its loader, reads only when it starts."""

_FORK_ARGUMENTS = (22, 23)
"""How many arguments ``_posixsubprocess.fork_exec`` has in Python 3.11 to 3.13 and 3.14."""

_REPORT = 13
"""Which of them is the pipe to the parent: it is closed where the application begins, and carries an error of what comes before."""

_NICE = 19


@dataclass(frozen=True)
class Start:
    """How an interpreter was to be started: with a module or a script."""

    command: tuple[str, ...]
    arguments: tuple[str, ...]
    module: str = ""
    script: str = ""
    unbuffered: bool = False

    @property
    def first_path(self) -> str:
        """The first entry of ``sys.path``."""
        return os.getcwd() if self.module else os.path.dirname(os.path.realpath(self.script))


def read_start(command: Sequence[str], interpreter: str) -> Start | None:
    """Return how a command starts ``interpreter`` (the file of its first word); None if it does not, or in another way.

    A script that names the interpreter in its first line starts it too.
    """
    arguments, unbuffered = list(command[1:]), False
    if not _is_this_interpreter(interpreter):
        named = _named_interpreter(interpreter)
        return Start(tuple(command), tuple(arguments), script=interpreter) if _is_this_interpreter(named) else None
    if arguments[:1] == ["-u"]:
        unbuffered, arguments = True, arguments[1:]
    if len(arguments) > 1 and arguments[0] == "-m":
        return Start(tuple(command), tuple(arguments[2:]), module=arguments[1], unbuffered=unbuffered)
    if arguments and not arguments[0].startswith("-"):
        return Start(tuple(command), tuple(arguments[1:]), script=arguments[0], unbuffered=unbuffered)
    return None


def _is_this_interpreter(path: str) -> bool:
    """Whether a file is the interpreter of this process: the same file in the same folder, since the folder is what makes a venv."""
    with contextlib.suppress(OSError):
        return os.path.samefile(path, sys.executable) and os.path.samefile(
            os.path.dirname(path), os.path.dirname(sys.executable)
        )
    return False


def _named_interpreter(script: str) -> str:
    """Return the interpreter in the first line of a script; empty if there is none, or with options."""
    with contextlib.suppress(OSError, UnicodeDecodeError), open(script, "rb") as file:
        if file.read(2) == b"#!":
            match file.readline(4096).decode().split():
                case [env, name] if os.path.basename(env) == "env":
                    return shutil.which(name) or ""
                case [path]:
                    return path
    return ""


def read_environment(text: str) -> dict[str, str]:
    """Read the variables of a file of ``understudy.api.protocol.hold_script.env_file``."""
    variables, words = {}, iter(shlex.split(text))
    for word in words:
        if word == "export":
            name, _, value = next(words).partition("=")
            variables[name] = value
        elif word not in ("set", "--", "env", "$@"):
            name, _, value = word.partition("=")
            variables[name] = value
    return variables


class PreloadedInterpreter:
    """An interpreter with modules in it, as it was before any application ran in it."""

    def __init__(self, modules: Sequence[str]) -> None:
        self._environment = dict(os.environ)
        self._path = list(sys.path)
        self._import(modules)
        self._modules = frozenset(sys.modules)
        self._threads = _threads()
        """Those of libraries, such as OpenBLAS, which start them again after a fork."""
        self._replaced: list[object] = []
        """What an application before this one left: kept, since its end would close files of this one."""
        gc.collect()
        gc.freeze()

    def _import(self, modules: Sequence[str]) -> None:
        """Import modules in a thread that leaves the processors to the robots that are driven. Those that fail are reported."""

        def importing() -> None:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
            for module in modules:
                begun = time.monotonic()
                try:
                    importlib.import_module(module)
                except BaseException as error:  # the application will see it too, if it needs that module
                    _report(f"cannot preload {module}: {type(error).__name__}: {error}")
                else:
                    _report(f"preloaded {module} in {time.monotonic() - begun:.2f} s")

        thread = threading.Thread(target=importing)
        thread.start()
        thread.join()

    def may_run(self, environment: Mapping[str, str]) -> bool:
        """Whether an application with this environment can run in this interpreter, or needs one of its own."""

        def read_at_start(variables: Mapping[str, str]) -> dict[str, str]:
            return {name: value for name, value in variables.items() if name.startswith(_READ_AT_START)}

        return read_at_start(environment) == read_at_start(self._environment)

    def run(self, start: Start) -> None:
        """Run an application as the interpreter does that was to be started, with the environment of this process.

        Raises SystemExit, and whatever else the application raises.
        """
        _write_command_line(start.command)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_DFL if number != signal.SIGINT else signal.default_int_handler)
        self._replaced.append(sys.modules["__main__"])
        main = sys.modules["__main__"] = types.ModuleType("__main__")
        main.__dict__["__builtins__"] = __builtins__
        sys.path[:] = [start.first_path, *self._path[1:]]
        sys.argv[:] = [start.script or "-m", *start.arguments]
        sys.orig_argv[:] = start.command
        if start.unbuffered:
            for stream in (sys.stdout, sys.stderr):
                stream.reconfigure(write_through=True)  # type: ignore[union-attr]
        if start.module:
            runpy._run_module_as_main(start.module)  # type: ignore[attr-defined]
            return
        with io.open_code(os.path.abspath(start.script)) as file:
            code = compile(file.read(), start.script, "exec")
        main.__dict__.update(__file__=start.script, __cached__=None)
        exec(code, main.__dict__)

    # -- further processes -------------------------------------------------------------------------------------------

    def fork_further_processes(self) -> None:
        """From now on, fork the Python processes that the application starts with :mod:`subprocess`, instead of executing them."""
        original: Callable[..., int] | None = getattr(subprocess, "_fork_exec", None)
        if original is not None:
            subprocess._fork_exec = lambda *given: self._fork_exec(original, given)  # type: ignore[attr-defined]

    def _fork_exec(self, original: Callable[..., int], given: Sequence[Any]) -> int:
        if len(given) not in _FORK_ARGUMENTS:
            return original(*given)
        words, files, _, _, directory, variables = given[:6]
        environment = _as_environment(variables)
        file = next((name for name in map(os.fsdecode, files) if os.access(name, os.X_OK)), "")
        start = read_start([os.fsdecode(word) for word in words], file) if directory is None and file else None
        if start is None or not self.may_run(environment) or not self._can_be_forked():
            return original(*given)
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()
        pid = os.fork()
        if pid == 0:
            self._child(start, environment, given)
        return pid

    def _can_be_forked(self) -> bool:
        """Whether a copy of this process can run another application: no thread of this one, no module of C that would be loaded again."""
        later = [module for name, module in sys.modules.items() if name not in self._modules]
        specs = [getattr(module, "__spec__", None) for module in later]
        return _threads() <= self._threads and not any(
            isinstance(getattr(spec, "loader", None), ExtensionFileLoader) for spec in specs
        )

    def _child(self, start: Start, environment: Mapping[str, str], given: Sequence[Any]) -> NoReturn:
        """Do in the new process what ``fork_exec`` does there, and run its application."""
        code = 1
        try:
            _prepare_child(given)
            self._forget(environment)
            os.close(given[_REPORT])  # the parent waits for it
            code = _exit_code(lambda: self.run(start))
        except BaseException as error:
            with contextlib.suppress(OSError):
                os.write(given[_REPORT], f"SubprocessError:0:{error}".encode())
        finally:
            os._exit(code)

    def _forget(self, environment: Mapping[str, str]) -> None:
        """Forget the application that started this one: its modules, handlers, environment and what it has not written yet."""
        gc.freeze()
        for name in [name for name in sys.modules if name not in self._modules and name != "__main__"]:
            self._replaced.append(sys.modules.pop(name))
        atexit._clear()
        sys.excepthook = sys.__excepthook__
        signal.set_wakeup_fd(-1)
        for number in signal.valid_signals():
            if callable(signal.getsignal(number)):
                signal.signal(number, signal.SIG_DFL)
        os.environ.clear()
        os.environ.update(environment)
        if (generator := getattr(sys.modules.get("numpy"), "random", None)) is not None:
            generator.seed()  # as Python's own is: no two processes draw the same numbers
        self._replaced.extend((sys.stdin, sys.stdout, sys.stderr))
        sys.stdin = sys.__stdin__ = _stream(0, "r")  # type: ignore[misc]
        sys.stdout = sys.__stdout__ = _stream(1, "w")  # type: ignore[misc]
        sys.stderr = sys.__stderr__ = _stream(2, "w", errors="backslashreplace", always=True)  # type: ignore[misc]


def _threads() -> frozenset[str]:
    return frozenset(os.listdir("/proc/self/task"))


def _as_environment(variables: Sequence[bytes] | None) -> dict[str, str]:
    if variables is None:
        return dict(os.environ)
    pairs = (os.fsdecode(variable).partition("=") for variable in variables)
    return {name: value for name, _, value in pairs}


def _stream(descriptor: int, mode: str, *, errors: str = "strict", always: bool = False) -> io.TextIOWrapper | None:
    """Return the text stream that an interpreter opens at its start; None if the descriptor is closed."""
    try:
        file = open(descriptor, f"{mode}b", closefd=False)  # noqa: SIM115  (it lives as long as the process)
    except OSError:
        return None
    unbuffered = bool(os.environ.get("PYTHONUNBUFFERED"))
    return io.TextIOWrapper(
        file, sys.getfilesystemencoding(), errors, line_buffering=always or file.isatty(), write_through=unbuffered
    )


def _prepare_child(given: Sequence[Any]) -> None:
    """Do what ``_posixsubprocess.fork_exec`` does between fork and exec, in its order."""
    (_, _, close_fds, keep, _, _, stdin, stdin_other, stdout_other, stdout, stderr_other, stderr, _, report) = given[
        :14
    ]
    _, new_session, group, gid, groups, uid, umask, preexec = given[14:22]  # Python ignores SIGPIPE at its start again
    for other in (stdin_other, stdout_other, stderr_other):
        if other != -1:
            os.close(other)
    wanted = [(stdin, 0), (stdout, 1), (stderr, 2)]
    # A descriptor that is about to be replaced moves out of the way first.
    wanted = [(os.dup(source) if -1 < source < target else source, target) for source, target in wanted]
    for source, target in wanted:
        if source == target:
            os.set_inheritable(source, True)
        elif source != -1:
            os.dup2(source, target)
    if umask >= 0:
        os.umask(umask)
    if new_session:
        os.setsid()
    if group >= 0:
        os.setpgid(0, group)
    if groups is not None:
        os.setgroups(groups)
    if gid is not None:
        os.setregid(gid, gid)
    if uid is not None:
        os.setreuid(uid, uid)
    if preexec is not None:
        preexec()
    for descriptor in [int(name) for name in os.listdir("/proc/self/fd")]:
        with contextlib.suppress(OSError):
            kept = descriptor in keep if close_fds else os.get_inheritable(descriptor)
            if descriptor > 2 and descriptor != report and not kept:
                os.close(descriptor)


def _exit_code(run: Callable[[], None]) -> int:
    """Run an application to its end, as an interpreter does, and return the process's exit status."""
    code = 0
    try:
        run()
    except SystemExit as end:
        if isinstance(end.code, int) or end.code is None:
            code = end.code or 0
        else:
            print(end.code, file=sys.stderr)
            code = 1
    except KeyboardInterrupt:
        traceback.print_exc()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    threading._shutdown()  # type: ignore[attr-defined,unused-ignore]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    return code


def _write_command_line(command: Sequence[str]) -> None:
    """Show this command in ``ps`` and /proc/self/cmdline, as far as it is no longer than the one there."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        begin, end = int(fields[45]), int(fields[46])  # arg_start and arg_end: fields 48 and 49 of proc(5)
        room = end - begin
        text = b"".join(os.fsencode(word) + b"\0" for word in command)[: max(0, room - 1)]
        if begin and room > 1:
            ctypes.memmove(begin, text.ljust(room, b"\0"), room)


def _report(text: str) -> None:
    print(f"understudy: {text}", file=sys.stderr, flush=True)


def _wait(environment: Path, wake: Path) -> None:
    """Wait for the environment, as HOLD_SCRIPT does: the FIFO first, then the file."""
    with open(os.open(wake, os.O_RDWR), "rb", buffering=0) as fifo:
        while not environment.exists():
            fifo.read(64)


def main(argv: Sequence[str]) -> None:
    """Import, wait, and run the command."""
    directory, container, skip, modules, *command = argv
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: os._exit(143))
    application = command[int(skip) :]
    found = read_start(application, sys.executable)
    if found is not None:
        sys.path[0] = found.first_path
    interpreter = PreloadedInterpreter([module for module in modules.split(",") if module])
    environment = Path(directory, f"env-{container}")
    _wait(environment, Path(directory, f"wake-{container}"))
    os.environ.update(read_environment(environment.read_text()))
    start = read_start(application, shutil.which(application[0]) or "")
    if start is None or Path(directory, f"fence-{container}").exists() or not interpreter.may_run(os.environ):
        os.execvp(command[0], command)
    interpreter.fork_further_processes()
    interpreter.run(start)


if __name__ == "__main__":
    main(sys.argv[1:])
