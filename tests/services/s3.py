"""An S3 server on loopback."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator

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
