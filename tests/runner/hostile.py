"""Submissions that mean harm. Each is a body of ``cmdFirmware`` (or of the constructor).

``{key}`` are the inverted bits of a number in the exact pose of a gate that is out of range.
``{secret}`` is a file beside the results that holds what the contestant must not learn,
``{outside}`` a folder it must not write to, ``{port}`` a TCP port of the runner's machine.
An attack that gets through writes BREACH to its output.
"""

IMPORTS = """\
import ctypes, gc, os, pickle, resource, signal, socket, struct, sys
import time as clock
import numpy as np
"""

# Those that must end their own trial: name -> (code, words in the reason).
FATAL = {
    "raise": ("raise RuntimeError('told you')", "told you"),
    "sys_exit": ("sys.exit(3)", "SystemExit"),
    "os_exit": ("os._exit(3)", "exit code 3"),
    "segfault": ("ctypes.string_at(0)", "SIGSEGV"),
    "abort": ("os.abort()", "SIGABRT"),
    "kill_itself": ("os.kill(os.getpid(), signal.SIGKILL)\n        clock.sleep(5)", ""),
    "base_exception": ("raise BaseException('no Exception')", "no Exception"),
    "keyboard_interrupt": ("raise KeyboardInterrupt", ""),
    "generator_exit": ("raise GeneratorExit", "GeneratorExit"),
    "recursion": ("f = lambda g: g(g)\n        f(f)", "Recursion"),
    "c_stack": (
        "ctypes.memset(ctypes.addressof(ctypes.c_char.from_buffer(bytearray(1))), 0, 1 << 40)",
        "SIG",
    ),
    "infinite_loop": ("while True:\n            pass", "no command for"),
    "sleep": ("clock.sleep(1000)", "no command for"),
    "ignore_signals": (
        "[signal.signal(n, signal.SIG_IGN) for n in (1, 2, 15)]\n        while True:\n"
        "            pass",
        "no command for",
    ),
    "memory_bomb": (
        "hog = []\n        while True:\n            hog.append(np.ones(1 << 24))",
        "",  # whichever comes first: no memory, or no time
    ),
    "close_every_file": ("os.closerange(0, 256)\n        return Command.NONE, []", ""),
    "close_channel": (
        "os.close(int(sys.argv[1]))\n        return Command.NONE, []",
        "",
    ),
    "garbage": (
        "os.write(int(sys.argv[1]), b'garbage')\n        return Command.NONE, []",
        "garbage",
    ),
    "huge_packet": (
        "os.write(int(sys.argv[1]), b'A' * 100000)\n        return Command.NONE, []",
        "garbage",
    ),
    "evil_pickle": (
        "class Evil:\n            def __reduce__(self):\n"
        "                return (os.system, ('touch {outside}/pickled',))\n"
        "        os.write(int(sys.argv[1]), pickle.dumps(Evil()))\n        return Command.NONE, []",
        "garbage",
    ),
    "forged_answer": (
        "os.write(int(sys.argv[1]), struct.pack('<cqbdd13d', b'A', 999, 0, 0.0, 0.0, *[0.0] * 13))"
        "\n        return Command.NONE, []",
        "not asked for",
    ),
    "answers_in_advance": (
        "for step in range(2000):\n"
        "            os.write(int(sys.argv[1]), struct.pack('<cqb15d', b'A', step, 0, *[0.0] * 15))"
        "\n        clock.sleep(1000)",
        "not asked for",
    ),
    "learns_for_ever": (
        "for _ in range(2000):\n"
        "            os.write(int(sys.argv[1]), struct.pack('<cqdd', b'T', 1, 0.0, 0.0))"
        "\n        return Command.NONE, []",
        "not asked for",
    ),
    "flood_channel": (
        "for _ in range(10000):\n            os.write(int(sys.argv[1]), b'x' * 1000)",
        "",
    ),
    "gigabyte_of_output": (
        "chunk = 'x' * (1 << 20)\n        for _ in range(1024):\n            print(chunk)",
        "File too large",
    ),
    "wrong_type": ("return 'take off', 3", "expected"),
    "not_finite": (
        "return Command.FULLSTATE, [[float('nan')] * 3, [0] * 3, [0] * 3, 0, [0] * 3]",
        "finite",
    ),
    "numbers_that_lie": (
        "class Liar(float):\n            def __float__(self):\n"
        "                return float('inf')\n"
        "        return Command.TAKEOFF, [Liar(1.0), 1.0]",
        "finite",
    ),
    "bad_repr": (
        "class Bad:\n            def __repr__(self):\n                os._exit(9)\n"
        "        return Bad(), []",
        "exit code 9",
    ),
}

# Those that fill the disk; on every kind of file system that a machine may give.
FILLERS = {
    "many_big_files": (
        "for k in range(500):\n            with open(f'{k}.bin', 'wb') as f:\n"
        "                f.write(b'x' * (10 << 20))",
        ("No space left", "of disk"),
    ),
    "big_files_at_home": (
        "block = b'x' * (10 << 20)\n        for k in range(500):\n"
        "            open(os.path.expanduser(f'~/{k}'), 'wb').write(block)",
        ("No space left", "of disk"),
    ),
    "million_small_files": (
        "for k in range(1000000):\n            open(f'{k}', 'w').close()",
        ("No space left", "files"),
    ),
    "folders_in_folders": (
        "while True:\n            os.mkdir('d')\n            os.chdir('d')",
        ("No space left", "files", "File name too long"),
    ),
}

# Those that are denied what they want: name -> code that must raise; the trial goes on.
DENIED = {
    "read_secret": "open('{secret}').read()",
    "list_results": "os.listdir('{outside}')",
    "write_outside": "open('{outside}/mine', 'w').write('x')",
    "delete_outside": "os.unlink('{secret}')",
    "link_to_secret": "os.symlink('{secret}', 'link'); open('link').read()",
    "hard_link": "os.link('{secret}', 'link')",
    "chmod_outside": "os.chmod('{secret}', 0o777)",
    "chmod_folder_outside": "os.chmod('{outside}', 0o777)",
    "chown_outside": "os.chown('{secret}', os.getuid(), os.getgid())",
    "utime_outside": "os.utime('{secret}', (1, 1))",
    "xattr_outside": "os.setxattr('{secret}', 'user.x', b'x')",
    "chmod_by_descriptor": "f = os.open('/usr', os.O_RDONLY); os.fchmod(f, 0o755)",
    "utime_of_the_system": "os.utime('/usr/bin/env')",
    "read_shadow": "open('/etc/shadow').read()",
    "memory_file": "os.memfd_create('mine')",
    "shared_segment": "assert ctypes.CDLL(None).shmget(0, 1 << 20, 0o1600) >= 0",
    "message_queue": "assert ctypes.CDLL(None).msgget(0, 0o1600) >= 0",
    "semaphores": "assert ctypes.CDLL(None).semget(0, 1, 0o1600) >= 0",
    "posix_queue": "assert ctypes.CDLL('librt.so.1').mq_open(b'/mine', 0o102, 0o600, None) >= 0",
    "tcp_out": "socket.create_connection(('127.0.0.1', {port}), 1).close()",
    "udp_out": "socket.socket(socket.AF_INET, socket.SOCK_DGRAM)",
    "unix_socket": "socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)",
    "raw_socket": "socket.socket(socket.AF_PACKET, socket.SOCK_RAW)",
    "listen": "socket.create_server(('127.0.0.1', 0)).close()",
    "kill_parent": "os.kill({runner}, signal.SIGTERM)",
    "read_parent_memory": "open('/proc/{runner}/mem', 'rb')",
    "read_parent_arguments": "open('/proc/{runner}/cmdline').read()",
    "ptrace": "assert ctypes.CDLL(None).ptrace(16, {runner}, 0, 0) == 0",
    "truth_in_memory": """
from crazyarena.sim_backend.arena_world import SimulatedArena
assert any(isinstance(o, SimulatedArena) for o in gc.get_objects())
""",
    "seed_in_memory": """
from crazyarena.levels.schema import Level
assert any(isinstance(o, Level) and o.seed for o in gc.get_objects())
""",
    "pose_in_memory": """
found = 0
for line in open('/proc/self/maps').readlines():
    span, rights = line.split()[:2]
    low, high = (int(end, 16) for end in span.split('-'))
    if rights.startswith('rw') and high - low < 1 << 28:
        data = ctypes.string_at(low, high - low)
        words = np.frombuffer(data, np.uint64, len(data) // 8)
        found += int((~words == np.uint64({key})).sum())
assert found
""",
    "motion_in_memory": """
from crazyarena.levels.schema import GateMotion
assert any(isinstance(o, GateMotion) for o in gc.get_objects())
""",
    "other_contestants": """
import glob, tempfile
folder = os.path.dirname(os.path.dirname(os.getcwd()))
others = glob.glob('/tmp/crazyarena-contestant-*/*')
assert any(not o.startswith(folder) for o in others)
""",
    "temporary_folder": "open('/tmp/mine', 'w').write('x')",
    "shared_memory": "open('/dev/shm/mine', 'w').write('x')",
    "root_folder": "open('/mine', 'w').write('x')",
    "raise_limits": "resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)",
    "real_time_priority": "os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(99))",
    "become_root": "os.seteuid(0); os.setuid(0); open('/etc/crazyarena-was-here', 'w')",
    "mount": "assert ctypes.CDLL(None).mount(b'none', b'/tmp', b'tmpfs', 0, None) == 0",
    "new_namespace": "assert ctypes.CDLL(None).unshare(0x10000000) == 0",
    "outlive_the_runner": "assert ctypes.CDLL(None).prctl(1, 0, 0, 0, 0) == 0",
    "open_device": "open('/dev/mem', 'rb')",
    "write_package": "import crazyarena; open(crazyarena.__file__, 'a')",
}
