"""Python runs this at its start when the folder is on PYTHONPATH: it plugs in virtual dongles.

It runs in programs of any kind, which must start as if it were not there: what it cannot do, it
says on standard error and leaves alone. Another ``sitecustomize`` behind it on the path runs too.
"""

import importlib.machinery
import importlib.util
import os
import sys


def _plug_in() -> None:
    address = os.environ.get("CRAZYARENA_VIRTUAL_RADIO")
    if not address:
        return
    try:
        import usb  # noqa: F401
    except ImportError:
        return  # a program without pyusb has no use for a dongle
    try:
        from crazyarena.sim_backend.crazyradio.remote import RemoteAir
        from crazyarena.sim_backend.crazyradio.usb_backend import install

        install(RemoteAir(address))
    except Exception as error:
        print(f"virtual radio: no dongle in this program: {error}", file=sys.stderr)


def _next_one() -> None:
    here = os.path.dirname(os.path.abspath(__file__))
    path = [folder for folder in sys.path if os.path.abspath(folder or ".") != here]
    spec = importlib.machinery.PathFinder.find_spec("sitecustomize", path)
    if spec is not None and spec.loader is not None:
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


_plug_in()
_next_one()
