"""Both ends of OpenIGTLink's connections: a server for many clients, and a client that connects again.

Each end has one thread, which connects, reads and writes: nobody else waits for the network.
"""

import asyncio
import queue
import socket
import threading
import time
from contextlib import suppress
from typing import Self

from speckle3d.core.errors import FileError
from speckle3d.io.igtl.messages import HEADER, MessageError, Received, body_bytes, decode

_LOOPBACK = "127.0.0.1"
STALL_S = 10.0
"""Longest time that a message may take."""

_LOOK_S = 0.005
"""Between two looks at what another thread does."""
_CONNECT_S, _PAUSE_S = 5.0, 0.5
"""Longest time to connect, and between two attempts."""
_MOST_MESSAGES, _MOST_UNSENT_BYTES = 256, 2**24
"""Messages not yet taken, for which the peer then waits; and what is not yet sent, above which no more is:
a dozen frames of 1 MB, half a second."""
_PIECE_BYTES = 2**20


class End:
    """One end of connections: a queue of received messages, counts, and the last failure.

    A message whose body makes no sense is refused alone. Where there is no header of a message, or the peer
    stalls within one, the connection is given up.

    Attributes
    ----------
    peers : int
        Connected now.
    refused : int
        Messages that made no sense; `last_refused` says why the last one did not.
    dropped : int
        Messages to a peer that it was too slow for.
    last_failure : str
        Why a connection was lost, or there is none.
    """

    peers = refused = dropped = 0
    last_refused = last_failure = ""

    def __init__(self) -> None:
        self._heard_s = time.monotonic()
        self._inbox: queue.Queue[Received] = queue.Queue(_MOST_MESSAGES)
        self._writers: list[asyncio.StreamWriter] = []
        self._loop, self._over = asyncio.new_event_loop(), asyncio.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def silent_s(self) -> float:
        """Time since the last message came."""
        return time.monotonic() - self._heard_s

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all connections; what was received and not taken can still be taken."""
        with suppress(RuntimeError):  # closed already
            self._loop.call_soon_threadsafe(self._over.set)
        if self._thread.is_alive():
            self._thread.join()

    def receive(self, timeout_s: float) -> list[Received]:
        """Take all messages in the order in which they came, waiting for the first one.

        Returns
        -------
        list
            Empty if none came in time.
        """
        messages: list[Received] = []
        with suppress(queue.Empty):
            messages.append(self._inbox.get(timeout_s > 0, timeout_s))
            while True:
                messages.append(self._inbox.get_nowait())
        return messages

    def send(self, message: bytes) -> None:
        """Send a packed message to all peers, without waiting for any: a slow one is left out."""
        with suppress(RuntimeError):  # closed meanwhile
            self._loop.call_soon_threadsafe(self._write, message)

    def _write(self, message: bytes) -> None:
        for writer in self._writers:
            if writer.transport.get_write_buffer_size() > _MOST_UNSENT_BYTES:
                self.dropped += 1
            else:
                writer.write(message)

    async def _serve(self) -> None:
        """Make connections, for ever."""
        raise NotImplementedError

    def _run(self) -> None:
        async def serve() -> None:
            serving = asyncio.create_task(self._serve())
            await self._over.wait()
            serving.cancel()

        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:  # which ends all that still runs
            runner.run(serve())

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Read, and be written to, until the connection is lost."""
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        writer.transport.set_write_buffer_limits(0)  # so that `drain` waits until all is sent
        self._writers.append(writer)
        self.peers += 1
        try:
            await self._read(reader)
        except (OSError, EOFError, MessageError) as error:
            self.last_failure = str(error) or f"expected a whole message within {STALL_S:g} s"
        finally:
            self._writers.remove(writer)
            self.peers -= 1
            writer.transport.abort()

    async def _read(self, reader: asyncio.StreamReader) -> None:
        while start := await reader.read(1):
            async with asyncio.timeout(STALL_S):
                start += await reader.readexactly(HEADER.size - 1)
                body = await reader.readexactly(body_bytes(start))
            self._heard_s = time.monotonic()
            try:
                message = decode(start, body)
            except MessageError as error:
                self.refused, self.last_refused = self.refused + 1, str(error)
                continue
            if message is None:
                continue
            while self._inbox.full():
                await asyncio.sleep(_LOOK_S)
            self._inbox.put_nowait(message)
        raise ConnectionError("closed by the peer")


class Connection(End):
    """A client of a server, as PLUS's, that connects again whenever the server was lost.

    Parameters
    ----------
    host : str
    port : int

    Examples
    --------
    >>> from speckle3d.io.igtl.messages import packed_transform
    >>> import numpy as np
    >>> with Server(0) as server, Connection("127.0.0.1", server.port) as connection:
    ...     while not server.peers:
    ...         time.sleep(0.01)
    ...     server.send(packed_transform("ProbeToTracker", 12.5, np.eye(4)))
    ...     received = connection.receive(5.0)
    >>> received[0].device, received[0].time_s, received[0].valid
    ('ProbeToTracker', 12.5, True)
    """

    def __init__(self, host: str, port: int) -> None:
        super().__init__()
        self._address = host, port

    async def _serve(self) -> None:
        while True:
            try:
                async with asyncio.timeout(_CONNECT_S):
                    streams = await asyncio.open_connection(*self._address, limit=_PIECE_BYTES)
                await self._talk(*streams)
            except (OSError, UnicodeError) as error:  # Unicode: a host that cannot be a name
                failure = str(error)
                is_refused = "Connect call failed" in failure
                self.last_failure = (
                    "nothing listens there: start it, or give its port" if is_refused else failure
                )
            await asyncio.sleep(_PAUSE_S)


class Server(End):
    """Sends every message to all its clients, as Slicer, and receives what they send.

    Parameters
    ----------
    port : int
        Of this machine alone; 0 for any free one, which `port` then tells.

    Raises
    ------
    FileError
        If the port is taken, or not for this user.
    """

    def __init__(self, port: int) -> None:
        super().__init__()
        try:
            self._socket = socket.create_server((_LOOPBACK, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise FileError(f"{_LOOPBACK}:{port}: expected a free port to listen on: {reason}") from error
        self.port = int(self._socket.getsockname()[1])

    def close(self) -> None:
        """Leave all clients and the port."""
        super().close()
        self._socket.close()

    def drain(self, timeout_s: float) -> None:
        """Wait until everything is sent to all clients, so long at most."""

        async def drained() -> None:
            await asyncio.gather(*(writer.drain() for writer in self._writers))

        with suppress(OSError):  # a client's that is lost, or too slow
            asyncio.run_coroutine_threadsafe(drained(), self._loop).result(timeout_s)

    async def _serve(self) -> None:
        async def welcome(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            with suppress(asyncio.CancelledError):  # of which asyncio would print a traceback
                await self._talk(reader, writer)

        await asyncio.start_server(welcome, sock=self._socket, limit=_PIECE_BYTES)
