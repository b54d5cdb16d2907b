"""The command, in a process of its own, for which its libraries are there already.

To import them and to load kernels takes most of the time of a small run, and there are hundreds.
So on Linux one process does that (`launch_server.py`), and forks for each run. Elsewhere, and
where the environment is another, each is started as usual. Tests of how the command starts and
ends, of signals and of memory start it themselves.
"""

import atexit
import json
import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest

SERVER = Path(__file__).with_name("launch_server.py")


def run(*arguments, text=True, data=b"", cwd=None, env=None, timeout=120):
    """Run it to its end; as `subprocess.run`, with what it wrote and its exit code.

    Args:
        arguments: Of the command; anything that `str` makes text of.
        text: Whether what it wrote is wanted as text.
        data: For its stdin, bytes; nothing is there without.
        cwd: Its folder; None for this one.
        env: Its environment; None for this one.
        timeout: Seconds after which it is ended, and the test fails.
    """
    words, env = list(map(str, arguments)), dict(os.environ if env is None else env)
    start = _forked if sys.platform == "linux" and read_early(env) == read_early() else _started
    code, *said = start(words, cwd or Path.cwd(), env, data, timeout)
    if text:
        said = [part.decode().replace("\r\n", "\n") for part in said]
    return subprocess.CompletedProcess(words, code, *said)


def run_here(*arguments):
    """Run it in this process, where what it calls can be patched; its exit code."""
    import nanogs.cli

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["nanogs", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            nanogs.cli.main()
    return ended.value.code


def read_early(env=os.environ):
    """The variables that what is imported reads at once."""
    names = ("NUMBA_", "PYTHON", "OMP_", "OPENBLAS_", "COLUMNS", "TERM", "NO_COLOR", "FORCE_COLOR")
    return {name: value for name, value in env.items() if name.startswith(names)}


def _started(words, cwd, env, data, timeout):
    """The exit code, stdout and stderr of a process as any."""
    command = [sys.executable, "-m", "nanogs", *words]
    done = subprocess.run(
        command, input=data, capture_output=True, cwd=cwd, env=env, timeout=timeout
    )
    return done.returncode, done.stdout, done.stderr


def _forked(words, cwd, env, data, timeout):
    """The same of one that the server forks."""
    server = _server(os.getpid(), tuple(sorted(read_early().items())))
    (stdin, feed), (out, stdout), (err, stderr) = (os.pipe() for _ in range(3))
    asked = json.dumps({"words": words, "cwd": str(cwd), "env": env})
    socket.send_fds(server, [asked.encode()], [stdin, stdout, stderr])
    for theirs in (stdin, stdout, stderr):
        os.close(theirs)
    with ThreadPoolExecutor(3) as pool:
        pool.submit(_feed, feed, data)
        said = [pool.submit(_drain, end) for end in (out, err)]
        code = _code(server, words, timeout)
        return code, *(part.result() for part in said)


def _feed(fd, data):
    with suppress(BrokenPipeError), os.fdopen(fd, "wb") as pipe:
        pipe.write(data)


def _drain(fd):
    with os.fdopen(fd, "rb") as pipe:
        return pipe.read()


def _code(server, words, timeout):
    server.settimeout(timeout)
    try:
        return int(server.recv(64) or pytest.fail("the server of runs has ended"))
    except TimeoutError:
        _server.cache_clear()
        server.close()  # whereupon it ends what it runs
        raise subprocess.TimeoutExpired(words, timeout) from None


@cache
def _server(_process, _early):
    """The line to a server of this process with the environment as it is."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        child = subprocess.Popen(
            [sys.executable, SERVER, str(theirs.fileno())], pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            env=dict(os.environ),  # without what C libraries of this process have set
        )  # fmt: skip

    def end():
        ours.close()
        child.wait()

    atexit.register(end)
    return ours
