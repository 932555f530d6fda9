"""OpenIGTLink against pyigtl, and both ends of a connection over the loopback."""

import socket
import time

import numpy as np
import pyigtl
import pytest
from igtl_examples import LAST, decode_whole, image, transform, with_body, with_values
from pyigtl.messages import MessageBase

from speckle3d.io.igtl import link
from speckle3d.io.igtl.link import Connection, Server
from speckle3d.io.igtl.messages import MessageError, packed_image, packed_transform

WAIT_S = 60.0
# Places are single precision in messages.
SINGLE = 1e-5


def by_pyigtl(message):
    fields = MessageBase.parse_header(message[:58])
    content = MessageBase.create_message(fields["message_type"])
    content.unpack(fields, message[58:])
    return content


@pytest.mark.parametrize("version", [1, 2])
def test_an_image_of_pyigtl_is_read(version):
    message, pixels, place = image(dtype="f4", version=version)
    ours = decode_whole(message)
    assert (ours.device, ours.time_s) == ("Image_Reference", 12.25)
    assert ours.pixels.dtype == "f4"
    np.testing.assert_array_equal(ours.pixels, pixels)
    np.testing.assert_allclose(ours.image_to_world, place, atol=SINGLE)
    np.testing.assert_allclose(ours.spacing_mm, [0.3, 0.1, 2.0], atol=SINGLE)


@pytest.mark.parametrize("shape", [(6, 9), (6, 9, 3)])
def test_pyigtl_and_we_read_an_image_of_ours(shape):
    pixels = np.random.default_rng(0).integers(0, 100, shape).astype(np.int16)
    colours, place = 3 if shape[-1] == 3 else 1, image()[2]
    message = packed_image("Volume", 1700000000.123456, pixels, place, colours)
    reference, ours = by_pyigtl(message), decode_whole(message)
    whole = pixels[:, :, None]
    np.testing.assert_array_equal(reference.image, whole.transpose(2, 1, 0, *range(3, whole.ndim)))
    np.testing.assert_array_equal(ours.pixels, pixels)
    np.testing.assert_allclose(
        [reference.ijk_to_world_matrix, ours.image_to_world], [place, place], atol=SINGLE
    )
    assert [reference.timestamp, ours.time_s] == pytest.approx([1700000000.123456] * 2, abs=1e-6)


@pytest.mark.parametrize(("metadata", "valid"), [
    ({}, True),
    ({"TransformValid": "False"}, False),
    ({"TransformStatus": "OUT_OF_VIEW"}, False),
])  # fmt: skip
def test_a_transform_of_plus_says_whether_the_tool_was_in_sight(metadata, valid):
    message, matrix = transform(version=2, **metadata)
    assert decode_whole(message).valid == valid
    np.testing.assert_allclose(decode_whole(message).matrix, matrix, atol=SINGLE)


IMAGE = image()[0]


@pytest.mark.parametrize("message", [
    with_values(6, ">3H", 65535, 65535, 65535),
    with_body(transform()[0], bytes(47)),
])  # fmt: skip
def test_what_makes_no_sense_is_refused_in_one_line(message):
    with pytest.raises(MessageError) as error:
        decode_whole(message)
    assert str(error.value).isprintable()


def until(is_so):
    end = time.monotonic() + WAIT_S
    while not is_so():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.005)


def take(receiver, count):
    messages, end = [], time.monotonic() + WAIT_S
    while len(messages) < count and time.monotonic() < end:
        messages += receiver.receive(0.1)
    return messages


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
        Connection("127.0.0.1", server.port) as first,
        Connection("127.0.0.1", server.port) as second,
    ):
        until(lambda: server.peers == 2)
        for message in images:
            server.send(message)
        for client in (first, second):
            messages = take(client, 50)
            assert [message.time_s for message in messages] == list(range(50))
            assert all((message.pixels == k).all() for k, message in enumerate(messages))
            assert (client.refused, client.dropped) == (0, 0)
        server.drain(WAIT_S)
        first.send(packed_transform("Pose", 1.0, np.eye(4)))
        assert [message.device for message in take(server, 1)] == ["Pose"]


def test_a_peer_that_is_too_slow_is_left_out_and_costs_others_nothing():
    message = packed_image("I", 1.0, np.zeros((1000, 1000), np.uint8), np.eye(4))
    with Server(0) as server, Connection("127.0.0.1", server.port) as quick:
        with socket.create_connection(("127.0.0.1", server.port)):
            until(lambda: server.peers == 2)
            for _ in range(40):
                server.send(message)
                assert len(take(quick, 1)) == 1
            assert server.dropped > 0
            server.drain(0.1)
        until(lambda: server.peers == 1)


def test_a_connection_waits_for_its_server_and_reconnects():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with Connection("127.0.0.1", port) as connection:
        until(lambda: "nothing listens" in connection.last_failure)
        assert not connection.peers
        for _ in range(2):
            with Server(port) as server:
                until(lambda: connection.peers)
                until(lambda: server.peers)
                server.send(LAST)
                assert [message.device for message in take(connection, 1)] == ["Last"]
            until(lambda: not connection.peers)


def test_a_damaged_body_is_refused_alone_and_a_damaged_header_ends_the_connection(listening):
    server, port = listening
    with Connection("127.0.0.1", port) as connection:
        peer, _ = server.accept()
        peer.sendall(LAST + IMAGE[:-1] + bytes([IMAGE[-1] ^ 1]) + LAST)
        assert len(take(connection, 2)) == 2
        assert (connection.peers, connection.refused) == (1, 1)
        assert "check sum" in connection.last_refused
        peer.sendall(b"\0\1no header" + bytes(100) + LAST)
        again, _ = server.accept()
        assert "header" in connection.last_failure
        again.sendall(LAST)
        assert len(take(connection, 1)) == 1
        peer.close()
        again.close()


@pytest.mark.parametrize("dies", [True, False])
def test_a_peer_that_dies_or_stalls_within_a_message_costs_that_message(listening, monkeypatch, dies):
    monkeypatch.setattr(link, "STALL_S", 0.3)
    server, port = listening
    with Connection("127.0.0.1", port) as connection:
        peer, _ = server.accept()
        peer.sendall(LAST)
        assert len(take(connection, 1)) == 1
        until(lambda: connection.silent_s > 0.5)  # silence between messages is no stall
        assert connection.peers
        peer.sendall(LAST + LAST[:70])
        if dies:
            peer.close()
        again, _ = server.accept()
        assert ("expected bytes" if dies else "0.3 s") in connection.last_failure
        again.sendall(LAST)
        assert len(take(connection, 2)) == 2
        peer.close()
        again.close()


def test_pyigtl_connects_to_our_server():
    client = None
    with Server(0) as server:
        try:
            client = pyigtl.OpenIGTLinkClient("127.0.0.1", server.port)
            until(lambda: server.peers)
            server.send(packed_image("Volume", 1.5, np.ones((3, 4, 5), np.uint8), np.eye(4)))
            assert client.wait_for_message("Volume", WAIT_S).image.shape == (5, 4, 3)
            client.send_message(pyigtl.TransformMessage(np.eye(4), 2.0, "Back"), wait=False)
            assert [message.device for message in take(server, 1)] == ["Back"]
        finally:
            if client is not None:
                client.stop()
