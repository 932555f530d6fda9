"""Both ends of a connection over the loopback: peers that stall, die, lie, come back, and are slow."""

import socket
import threading
import time
import tracemalloc

import igtl_examples
import numpy as np
import pytest
from igtl_examples import LAST

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.io.igtl.connection import Connection
from speckle3d.io.igtl.messages import ImageReceived, Limits, packed_image, packed_transform
from speckle3d.io.igtl.server import Server

WAIT_S = 60.0


def until(is_so, timeout_s=WAIT_S):
    end = time.monotonic() + timeout_s
    while not is_so():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.005)


def taken(receiver, count):
    found, end = [], time.monotonic() + WAIT_S
    while len(found) < count and time.monotonic() < end:
        found += receiver.receive(0.1)
    return found


@pytest.fixture
def listening():
    """A bare socket that a client connects to, and the client's port."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(WAIT_S)
        yield server, server.getsockname()[1]


def test_every_message_comes_in_order_to_every_client_and_back():
    images = [packed_image("I", k, np.full((40, 300), k, np.int16), np.eye(4)) for k in range(50)]
    with (
        Server(0) as server,
        Connection("127.0.0.1", server.port) as one,
        Connection("127.0.0.1", server.port) as two,
    ):
        until(lambda: server.clients == 2)
        for image in images:
            server.send(image)
        for client in (one, two):
            found = taken(client, 50)
            assert [each.time_s for each in found] == list(range(50))
            assert all((each.pixels == k).all() for k, each in enumerate(found))
            assert (client.state.messages, client.state.refused, client.state.dropped) == (50, 0, 0)
        assert server.drain(WAIT_S)
        one.send(packed_transform("Pose", 1.0, np.eye(4)))
        assert [each.device for each in taken(server, 1)] == ["Pose"]


def test_a_connection_waits_for_its_server_and_finds_it_again():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with Connection("127.0.0.1", port) as connection:
        until(lambda: "refused" in connection.state.last_failure)
        assert not connection.state.connected
        for k in range(2):
            with Server(port) as server:
                assert connection.wait_connected(WAIT_S)
                assert server.wait_connected(WAIT_S)
                server.send(LAST)
                assert [each.device for each in taken(connection, 1)] == ["Last"]
                assert connection.state.reconnections == k
            until(lambda: not connection.state.connected)
            assert connection.receive(0.0) == []


def test_a_damaged_message_is_refused_and_the_connection_stays(listening):
    server, port = listening
    with Connection("127.0.0.1", port) as connection:
        peer, _ = server.accept()
        spoilt = bytearray(igtl_examples.image()[0])
        spoilt[-1] ^= 1
        peer.sendall(LAST + bytes(spoilt) + LAST)
        assert len(taken(connection, 2)) == 2
        state = connection.state
        assert (state.connected, state.messages, state.refused) == (True, 2, 1)
        assert "check sum" in state.last_refused
        peer.close()


def test_a_peer_that_dies_within_a_message_costs_that_message(listening):
    server, port = listening
    with Connection("127.0.0.1", port) as connection:
        peer, _ = server.accept()
        peer.sendall(LAST + LAST[:70])
        peer.close()
        peer, _ = server.accept()
        assert "within a message" in connection.state.last_failure
        peer.sendall(LAST)
        assert len(taken(connection, 2)) == 2
        assert connection.state.reconnections == 1
        peer.close()


def test_a_peer_that_stalls_within_a_message_is_left_and_found_again(listening):
    server, port = listening
    with Connection("127.0.0.1", port, Limits(stall_s=0.3)) as connection:
        peer, _ = server.accept()
        peer.sendall(LAST[:70])
        again, _ = server.accept()
        assert "0.3 s" in connection.state.last_failure
        again.sendall(LAST)
        assert len(taken(connection, 1)) == 1
        peer.close()
        again.close()


def test_silence_between_messages_is_no_stall(listening):
    server, port = listening
    with Connection("127.0.0.1", port, Limits(stall_s=0.05)) as connection:
        peer, _ = server.accept()
        peer.sendall(LAST)
        assert len(taken(connection, 1)) == 1
        until(lambda: connection.state.silent_s > 0.3)
        peer.sendall(LAST)
        assert len(taken(connection, 1)) == 1
        assert connection.state.reconnections == 0
        peer.close()


def test_what_nobody_takes_waits_at_the_peer_and_nothing_is_lost():
    image = packed_image("I", 0.0, np.zeros((500, 1000), np.int16), np.eye(4))
    limits = Limits(max_waiting_bytes=3_000_000)
    with Server(0, limits=Limits(max_sending_bytes=200 * len(image))) as server:
        tracemalloc.start()
        with Connection("127.0.0.1", server.port, limits) as connection:
            assert server.wait_connected(WAIT_S)
            for _ in range(60):
                server.send(image)
            until(lambda: connection.state.waiting == 3)
            time.sleep(0.2)
            assert connection.state.waiting == 3
            tracemalloc.stop()
            assert len(taken(connection, 60)) == 60
            assert server.state.dropped == 0


def test_a_peer_that_reads_nothing_loses_the_oldest_and_nobody_waits_for_it(listening):
    server, port = listening
    limits = Limits(max_sending_bytes=3_000_000)
    with Connection("127.0.0.1", port, limits) as connection:
        peer, _ = server.accept()
        image = np.zeros((500, 1000), np.int16)
        begin = time.monotonic()
        for k in range(60):
            connection.send(packed_image("I", k, image, np.eye(4)))
        assert time.monotonic() - begin < WAIT_S
        dropped = connection.state.dropped
        assert dropped > 20
        found, framing = [], igtl_examples.Framing()
        peer.settimeout(WAIT_S)
        while not found or found[-1].time_s < 59:
            found += framing.feed(peer.recv(2**20))
        assert len(found) + dropped == 60
        assert [each.time_s for each in found] == sorted(each.time_s for each in found)
        assert all(isinstance(each, ImageReceived) for each in found)
        peer.close()
        with pytest.raises(InvalidInputError, match="at most 3000000"):
            connection.send(bytes(3_000_001))


def test_closing_waits_for_nobody(listening):
    _, port = listening
    limits = Limits(max_waiting_bytes=1)
    with Connection("127.0.0.1", port, limits) as connection:
        assert connection.wait_connected(WAIT_S)
        connection.send(bytes(2**24))
        begin = time.monotonic()
    assert time.monotonic() - begin < 5.0
    assert not [each for each in threading.enumerate() if "_read" in each.name]


def test_a_client_may_come_and_go(listening):
    with Server(0) as server:
        for _ in range(20):
            socket.create_connection(("127.0.0.1", server.port)).close()
        until(lambda: server.state.reconnections == 19 and server.clients == 0)
        with Connection("127.0.0.1", server.port) as connection:
            until(lambda: server.clients == 1)
            server.send(LAST)
            assert len(taken(connection, 1)) == 1


def test_a_taken_port_is_one_line():
    with Server(0) as server, pytest.raises(FileError, match="free port"):
        Server(server.port)


def test_pyigtl_connects_to_our_server():
    import pyigtl

    client = None
    with Server(0) as server:
        try:
            client = pyigtl.OpenIGTLinkClient("127.0.0.1", server.port)
            assert server.wait_connected(WAIT_S)
            server.send(packed_image("Volume", 1.5, np.ones((3, 4, 5), np.uint8), np.eye(4)))
            found = client.wait_for_message("Volume", WAIT_S)
            assert found.image.shape == (5, 4, 3)
            client.send_message(pyigtl.TransformMessage(np.eye(4), 2.0, "Back"), wait=False)
            assert [each.device for each in taken(server, 1)] == ["Back"]
        finally:
            if client is not None:
                client.stop()


def test_a_host_that_cannot_be_a_name_is_told_and_does_not_end_the_thread():
    with Connection("a..b", 18944) as connection:
        until(lambda: "label" in connection.state.last_failure)
        assert not connection.state.connected
