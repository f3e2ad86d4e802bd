"""An S3 server on loopback, and a way to it that ends at a request."""

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from socketserver import StreamRequestHandler, ThreadingTCPServer
from threading import Thread

import pytest
from helpers import wait_until

ACCESS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """URL of a bucket that this process and those it starts can reach."""
    import boto3

    command = [sys.executable, "-m", "moto.server", "--host", "127.0.0.1", "--port", "0"]
    unbuffered = os.environ | {"PYTHONUNBUFFERED": "1"}
    with (
        tempfile.TemporaryFile("w+") as log,
        subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=unbuffered) as process,
        pytest.MonkeyPatch.context() as patch,
    ):

        def address():
            log.seek(0)
            return [word for word in log.read().split() if word.startswith("http://127.0.0.1:")]

        try:
            wait_until(address, "server")
            for name, value in {**ACCESS, "AWS_ENDPOINT_URL": address()[0]}.items():
                patch.setenv(name, value)
            boto3.client("s3").create_bucket(Bucket="bucket")
            yield "s3://bucket"
        finally:
            process.kill()


@contextmanager
def away_from(request: str) -> Iterator[str]:
    """Address of the server until it is asked for this, such as ``PUT /bucket/name``: then nothing answers there."""
    host, port = os.environ["AWS_ENDPOINT_URL"].removeprefix("http://").split(":")

    class Handler(StreamRequestHandler):
        def handle(self) -> None:
            with suppress(OSError), socket.create_connection((host, int(port))) as server:
                Thread(target=copy, args=(server, self.request), daemon=True).start()
                copy(self.request, server, request.encode())

    def copy(source: socket.socket, target: socket.socket, last: bytes = b"nothing") -> None:
        with suppress(OSError):
            while content := source.recv(1 << 16):
                if last in content:
                    way.server_close()  # refuses connections
                    Thread(target=way.shutdown).start()
                    source.shutdown(socket.SHUT_RDWR)
                    return
                target.sendall(content)
            target.shutdown(socket.SHUT_WR)

    class Way(ThreadingTCPServer):
        allow_reuse_address, daemon_threads, block_on_close = True, True, False

    way = Way(("127.0.0.1", 0), Handler)
    thread = Thread(target=way.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{way.server_address[1]}"
    finally:
        way.server_close()
        way.shutdown()
        thread.join()
