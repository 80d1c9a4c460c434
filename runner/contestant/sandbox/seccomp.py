"""seccomp: system calls that no controller needs fail with EPERM.

Sockets of every kind, tracing and reading other processes, namespaces and mounts, kernel
keyrings, BPF, io_uring, which would get around a filter like this one, and memory that no limit
of a process or file system counts (memfd, System V). Where no root of its own keeps it away from
other people's files, also changing permissions, owners, times and attributes of any file, which
Landlock does not cover.
"""

from __future__ import annotations

import ctypes
import errno
import platform
import struct

from crazyarena.runner.contestant.sandbox import kernel

# Numbers of x86_64 and aarch64 (include/uapi/asm-generic/unistd.h); the latter's table lacks some.
_DENIED = {
    "socket": (41, 198),
    "ptrace": (101, 117),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "pidfd_open": (434, 434),
    "pidfd_getfd": (438, 438),
    "pidfd_send_signal": (424, 424),
    "kcmp": (312, 272),
    "mount": (165, 40),
    "umount2": (166, 39),
    "pivot_root": (155, 41),
    "chroot": (161, 51),
    "unshare": (272, 97),
    "setns": (308, 268),
    "open_by_handle_at": (304, 265),
    "open_tree": (428, 428),
    "move_mount": (429, 429),
    "fsopen": (430, 430),
    "fsmount": (432, 432),
    "mount_setattr": (442, 442),
    "bpf": (321, 280),
    "perf_event_open": (298, 241),
    "userfaultfd": (323, 282),
    "io_uring_setup": (425, 425),
    "keyctl": (250, 219),
    "add_key": (248, 217),
    "request_key": (249, 218),
    "kexec_load": (246, 104),
    "init_module": (175, 105),
    "finit_module": (313, 273),
    "delete_module": (176, 106),
    "swapon": (167, 224),
    "reboot": (169, 142),
    "settimeofday": (164, 170),
    "clock_settime": (227, 112),
    "setpriority": (141, 140),
    "sched_setscheduler": (144, 119),
    "sched_setattr": (314, 274),
    "mlockall": (151, 230),
    "syslog": (103, 116),
    "quotactl": (179, 60),
    "acct": (163, 89),
    "sethostname": (170, 161),
}
_MEMORY = {
    "memfd_create": (319, 279),
    "memfd_secret": (447, 447),
    "shmget": (29, 194),
    # What lies in queues is nobody's memory, outlives its maker, and others can read it.
    "msgget": (68, 186),
    "semget": (64, 190),
    "mq_open": (240, 180),
}
# Of aarch64, only those that take a descriptor exist.
_METADATA: dict[str, tuple[int, int | None]] = {
    "chmod": (90, None),
    "fchmod": (91, 52),
    "fchmodat": (268, 53),
    "fchmodat2": (452, 452),
    "chown": (92, None),
    "fchown": (93, 55),
    "lchown": (94, None),
    "fchownat": (260, 54),
    "utime": (132, None),
    "utimes": (235, None),
    "futimesat": (261, None),
    "utimensat": (280, 88),
    "setxattr": (188, 5),
    "lsetxattr": (189, 6),
    "fsetxattr": (190, 7),
    "removexattr": (197, 14),
    "lremovexattr": (198, 15),
    "fremovexattr": (199, 16),
    "setxattrat": (463, 463),
    "removexattrat": (466, 466),
    "file_setattr": (469, 469),
}
_IOCTL = (16, 29)
_SET_FLAGS = (0x40086602, 0x401C5820)  # FS_IOC_SETFLAGS, FS_IOC_FSSETXATTR
_KILL = (62, 129)
_CLONE, _CLONE3, _PRCTL = (56, 220), (435, 435), (157, 167)
_ARCHITECTURE = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
_NEW_NAMESPACES = (
    kernel.CLONE_NEWNS
    | kernel.CLONE_NEWCGROUP
    | kernel.CLONE_NEWUTS
    | kernel.CLONE_NEWIPC
    | kernel.CLONE_NEWUSER
    | kernel.CLONE_NEWPID
    | kernel.CLONE_NEWNET
)
_X32 = 0x40000000

# Classic BPF.
_LOAD, _JUMP_EQUAL, _JUMP_SET, _JUMP_AT_LEAST, _RETURN = 0x20, 0x15, 0x45, 0x35, 0x06
_NUMBER_AT, _ARCH_AT, _FIRST_ARGUMENT_AT, _SECOND_ARGUMENT_AT = 0, 4, 16, 24
_ALLOW, _FAIL, _KILL_PROCESS = 0x7FFF0000, 0x00050000, 0x80000000
_MODE_FILTER = 2


def _op(code: int, k: int, yes: int = 0, no: int = 0) -> bytes:
    return struct.pack("<HBBI", code, yes, no, k)


def _program(deny_kill: bool, deny_metadata: bool) -> bytes | None:
    known = _ARCHITECTURE.get(platform.machine())
    if known is None:
        return None
    column, architecture = known
    ops = [
        _op(_LOAD, _ARCH_AT),
        _op(_JUMP_EQUAL, architecture, 1, 0),
        _op(_RETURN, _KILL_PROCESS),
        _op(_LOAD, _NUMBER_AT),
    ]
    if column == 0:
        ops += [_op(_JUMP_AT_LEAST, _X32, 0, 1), _op(_RETURN, _FAIL | errno.ENOSYS)]
    numbers = [row[column] for row in (*_DENIED.values(), *_MEMORY.values())]
    if deny_kill:
        numbers.append(_KILL[column])
    if deny_metadata:
        numbers += [n for row in _METADATA.values() if (n := row[column]) is not None]
    for number in sorted(set(numbers)):
        ops += [_op(_JUMP_EQUAL, number, 0, 1), _op(_RETURN, _FAIL | errno.EPERM)]
    # Of clone3 a filter cannot see the flags: the C library falls back to clone.
    ops += [_op(_JUMP_EQUAL, _CLONE3[column], 0, 1), _op(_RETURN, _FAIL | errno.ENOSYS)]
    ops += [
        _op(_JUMP_EQUAL, _CLONE[column], 0, 4),
        _op(_LOAD, _FIRST_ARGUMENT_AT),
        _op(_JUMP_SET, _NEW_NAMESPACES, 0, 1),
        _op(_RETURN, _FAIL | errno.EPERM),
        _op(_RETURN, _ALLOW),
    ]
    if deny_metadata:
        ops += [
            _op(_JUMP_EQUAL, _IOCTL[column], 0, 5),
            _op(_LOAD, _SECOND_ARGUMENT_AT),
            _op(_JUMP_EQUAL, _SET_FLAGS[0], 1, 0),
            _op(_JUMP_EQUAL, _SET_FLAGS[1], 0, 1),
            _op(_RETURN, _FAIL | errno.EPERM),
            _op(_RETURN, _ALLOW),
        ]
    # The signal that ends it with the runner must stay as it is.
    ops += [
        _op(_JUMP_EQUAL, _PRCTL[column], 0, 3),
        _op(_LOAD, _FIRST_ARGUMENT_AT),
        _op(_JUMP_EQUAL, kernel.PR_SET_PDEATHSIG, 0, 1),
        _op(_RETURN, _FAIL | errno.EPERM),
        _op(_RETURN, _ALLOW),
    ]
    return b"".join(ops)


class _Filter(ctypes.Structure):
    _fields_ = [("length", ctypes.c_ushort), ("program", ctypes.c_char_p)]


def restrict(deny_kill: bool, deny_metadata: bool) -> bool:
    """Install the filter, for good; needs "no new privileges". False if the kernel cannot.

    ``deny_kill`` also denies signals to anybody, ``deny_metadata`` changing permissions, owners,
    times and attributes of files, where nothing else keeps them inside.
    """
    program = _program(deny_kill, deny_metadata)
    if program is None:
        return False
    try:
        kernel.prctl(
            kernel.PR_SET_SECCOMP,
            _MODE_FILTER,
            ctypes.byref(_Filter(len(program) // 8, program)),
        )
    except OSError:
        return False
    return True
