"""Runs a verb as on Windows: modules of ``skin`` find nothing that only POSIX systems have.

Without a verb it imports every module and shows the help of every verb. Libraries find all that there is.
"""

import builtins
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

MODULES = {"crypt", "fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"}
NAMES = {
    "os": """
        O_CLOEXEC O_DIRECTORY O_NOCTTY O_NONBLOCK O_SYNC WNOHANG chown chroot ctermid fchmod fchown
        fdatasync fork forkpty getegid geteuid getgid getgroups getloadavg getpgid getpgrp getsid
        getuid initgroups killpg lockf mkfifo mknod nice openpty pipe2 posix_fadvise posix_fallocate
        posix_openpt posix_spawn pread preadv pwrite pwritev readv register_at_fork sched_getaffinity
        sched_setaffinity sched_yield sendfile set_blocking setgid setpgid setpriority setsid setuid
        statvfs sync sysconf tcgetpgrp tcsetpgrp ttyname uname wait wait3 wait4 waitid writev
    """,
    "select": "POLLERR POLLHUP POLLIN POLLOUT epoll poll",
    "signal": """
        SIGALRM SIGBUS SIGCHLD SIGCONT SIGHUP SIGIO SIGKILL SIGPIPE SIGPROF SIGQUIT SIGSTOP SIGTSTP SIGTTIN
        SIGTTOU SIGUSR1 SIGUSR2 SIGWINCH alarm getitimer pause pthread_kill pthread_sigmask setitimer
        siginterrupt sigpending sigtimedwait sigwait sigwaitinfo
    """,
    "socket": "AF_UNIX AF_NETLINK CMSG_LEN recv_fds send_fds sethostname",
    "time": "clock_settime pthread_getcpuclockid tzset",
}


def hide() -> None:
    """Replace what ``import`` gives to modules of ``skin``."""
    shown, usual = {name: _without(name, text.split()) for name, text in NAMES.items()}, builtins.__import__

    def imported(name: str, globals: Any = None, *others: Any, **rest: Any) -> Any:
        if str((globals or {}).get("__name__")).split(".")[0] != "skin":
            return usual(name, globals, *others, **rest)
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return shown.get(name) or usual(name, globals, *others, **rest)

    builtins.__import__ = imported


def _without(name: str, hidden: list[str]) -> ModuleType:
    shown, found = ModuleType(name), vars(import_module(name))
    shown.__dict__.update({key: value for key, value in found.items() if key not in hidden})
    return shown


def main() -> None:
    """Run the verb of the command line; without one, import every module and show every verb's help."""
    hide()
    import skin.__main__

    if sys.argv[1:]:
        skin.__main__.main()
        return
    folder = Path(skin.__file__).parent
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(folder.parent).with_suffix("").parts
        if parts[-1] not in ("__init__", "__main__"):
            import_module(".".join(parts))
    for verb in skin.__main__.verbs():
        skin.__main__.main([verb, "--help"])


if __name__ == "__main__":
    main()
