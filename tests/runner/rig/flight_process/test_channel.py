"""Whole messages through a socket, and none lost when the other side does not read."""

import socket
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.runner.rig.flight_process.channel import PatientSender, Receiver, Sender


@pytest.fixture
def pair():
    ours, theirs = socket.socketpair()
    yield ours, theirs
    ours.close()
    theirs.close()


def collect(receiver, count):
    got = []
    while len(got) < count:
        got += receiver.receive(10.0)
    return got


@given(st.lists(st.binary(max_size=3000), max_size=30), st.lists(st.integers(1, 500)))
def test_messages_survive_any_cutting(messages, cuts):
    ours, theirs = socket.socketpair()
    with ours, theirs:
        whole, raw = socket.socketpair()
        with whole, raw:
            sender = Sender(whole)
            for message in messages:
                sender.send(message)
            whole.shutdown(socket.SHUT_WR)
            data = b""
            while chunk := raw.recv(1 << 20):
                data += chunk
        receiver = Receiver(theirs)
        got = []
        for cut in cuts:
            ours.sendall(data[:cut])
            data = data[cut:]
            got += receiver.receive(0.0)
        ours.sendall(data)
        ours.shutdown(socket.SHUT_WR)
        got += collect(receiver, len(messages) - len(got))
        assert got == messages
        with pytest.raises(EOFError):
            receiver.receive(10.0)


def test_nothing_is_lost_and_nobody_waits_while_the_reader_is_stalled(pair):
    ours, theirs = pair
    sender = PatientSender(ours)
    messages = [i.to_bytes(4, "little") * 250 for i in range(20_000)]  # 20 MB
    for message in messages:
        sender.send(message)  # would never return if it waited
    receiver = Receiver(theirs)
    assert collect(receiver, len(messages)) == messages
    # And it goes on as before.
    sender.send(b"more")
    assert collect(receiver, 1) == [b"more"]
    sender.close()


def test_many_threads_may_send(pair):
    ours, theirs = pair
    sender = PatientSender(ours)

    def send(k):
        for i in range(2000):
            sender.send(bytes([k]) * (i % 700 + 1))

    threads = [threading.Thread(target=send, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    got = collect(Receiver(theirs), 8000)
    for thread in threads:
        thread.join()
    for k in range(4):
        own = [m for m in got if m[0] == k]
        assert own == [bytes([k]) * (i % 700 + 1) for i in range(2000)]
    sender.close()


def test_a_reader_that_is_gone_does_not_matter(pair):
    ours, theirs = pair
    sender = PatientSender(ours)
    theirs.close()
    for _ in range(100):
        sender.send(bytes(10_000))
    sender.close()


def test_what_came_before_the_end_is_read(pair):
    ours, theirs = pair
    Sender(ours).send(b"last words")
    ours.close()
    receiver = Receiver(theirs)
    assert receiver.receive(1.0) == [b"last words"]
    with pytest.raises(EOFError):
        receiver.receive(1.0)
