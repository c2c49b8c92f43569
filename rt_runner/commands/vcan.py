"""``rt-runner vcan up|down|status``: the virtual CAN interface, where the kernel can have one."""


def add_parser(subparsers) -> None:
    """Add the verb."""
    p = subparsers.add_parser(
        "vcan", help="create, remove or show the virtual CAN interface", description="Virtual CAN interface."
    )
    p.add_argument("action", choices=("up", "down", "status"))
    p.add_argument("--name", default="vcan0", help="interface (default: vcan0)")
    p.add_argument("--json", metavar="FILE", help="write what was found as JSON ('-': standard output)")
    p.set_defaults(run=run)


def run(args) -> int:
    """Do it; returns the exit status: 0 done (``status``: the interface is up), 1 not."""
    import dataclasses
    import re

    from rt_runner.bus import can_trouble, look_up
    from rt_runner.errors import UsageError
    from rt_runner.present import write_json

    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_.-]{0,14}", str(args.name)):
        raise UsageError(f"--name {args.name!r}: give an interface name such as vcan0")
    if args.action == "up":
        _up(args.name)
    elif args.action == "down":
        _down(args.name)
    now = look_up(args.name)
    trouble = can_trouble()
    if not now.exists:
        text = f"{args.name} does not exist" + (f": {trouble}" if trouble else "")
    elif not now.is_can:
        text = f"{args.name} is not a CAN interface"
    else:
        text = f"{args.name} is {'up' if now.up else 'down'}"
    write_json({**dataclasses.asdict(now), "can_support": trouble is None, "text": text}, args.json)
    if args.json != "-":
        print(text)
    return 0 if args.action != "status" or (now.is_can and now.up) else 1


def _ip(*arguments: str) -> str | None:
    """Run iproute2; gives what it complains about, None if nothing."""
    import shutil
    import subprocess

    from rt_runner.errors import SetupError

    ip = shutil.which("ip") or shutil.which("ip", path="/usr/sbin:/sbin")
    if ip is None:
        raise SetupError("the program 'ip' is missing: install it with 'tools/apt-install iproute2'")
    done = subprocess.run([ip, *arguments], capture_output=True, text=True, timeout=30)
    if done.returncode == 0:
        return None
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    if not lines:
        return f"{ip} ended with status {done.returncode}"
    return lines[-1].removeprefix("RTNETLINK answers: ").strip()


def _load_modules() -> None:
    """Try to load the kernel's vcan; whether it helped shows when the interface is made."""
    import contextlib
    import shutil
    import subprocess

    modprobe = shutil.which("modprobe") or shutil.which("modprobe", path="/usr/sbin:/sbin")
    if modprobe is not None:
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            subprocess.run([modprobe, "vcan"], capture_output=True, timeout=30)


def _up(name: str) -> None:
    import os

    from rt_runner.bus import can_trouble, look_up
    from rt_runner.errors import SetupError

    found = look_up(name)
    if found.exists and not found.is_can:
        raise SetupError(f"{name} is not a CAN interface: choose another --name")
    if found.up:
        return
    if not found.exists:
        _load_modules()
        trouble = can_trouble()
        if trouble is None:
            # MTU 72: CAN FD frames, too; vcan takes it at creation only while the interface is down.
            trouble = _ip("link", "add", "dev", name, "mtu", "72", "type", "vcan")
        if trouble is not None:
            if os.geteuid() != 0 and "not permitted" in trouble:
                raise SetupError(f"cannot create {name}: {trouble}; run it as root: sudo rt-runner vcan up")
            raise SetupError(
                f"cannot create {name}: {trouble}; take the user-space bus (--bus hub), or run the command "
                "where there is a CAN: tools/vcan-lab -- COMMAND"
            )
    trouble = _ip("link", "set", "dev", name, "up")
    if trouble is not None:
        raise SetupError(f"cannot bring {name} up: {trouble}; it needs root: sudo rt-runner vcan up")


def _down(name: str) -> None:
    from rt_runner.bus import look_up
    from rt_runner.errors import SetupError

    found = look_up(name)
    if not found.exists:
        return
    if not found.is_can:
        raise SetupError(f"{name} is not a CAN interface: it is left alone")
    trouble = _ip("link", "delete", "dev", name, "type", "vcan")
    if trouble is not None:
        raise SetupError(f"cannot remove {name}: {trouble}; only virtual interfaces go, and it needs root")
