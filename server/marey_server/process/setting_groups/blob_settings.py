"""Settings of the storage of blobs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from pydantic import Field, ValidationInfo, field_validator
from pydantic_settings import BaseSettings

from marey_schemas.sizes import MIB
from marey_server.process.secret_files import read_secret
from marey_server.store.object_storage.client import Bucket


class BlobSettings(BaseSettings):
    """Settings that say where a server stores the bytes of blobs."""

    blobs: Literal["database", "directory", "s3"] = Field(
        "database",
        description="Storage of new blobs: in the database, in the folder `blobs` of the data folder, or as objects in "
        "s3_bucket.",
    )
    s3_bucket: str | None = Field(
        None,
        validate_default=True,
        min_length=3,
        max_length=63,
        description="Bucket for blobs; it is also read if new blobs are stored elsewhere.",
    )
    s3_endpoint: str | None = Field(
        None, description="Address of the S3 server, such as https://s3.internal:9000; absent: Amazon S3."
    )
    s3_region: str = Field("us-east-1", description="Region of the bucket; many S3 servers accept any name.")
    s3_prefix: str = Field(
        "", max_length=200, description="First part of the names of all objects, if the bucket has other users."
    )
    s3_key_id: str | None = Field(
        None,
        description="Id of the access key of the bucket. Absent: the credentials are those of the variables "
        "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or of the role of the machine or pod.",
    )
    s3_secret_key_file: Path | None = Field(
        None, validate_default=True, description="File that contains the secret of s3_key_id and nothing else."
    )
    s3_timeout_s: float = Field(
        30.0,
        ge=1,
        le=300,
        description="Seconds that a request to the S3 server may take; failed requests are repeated for this time.",
    )
    s3_redirect_bytes: int | None = Field(
        None,
        ge=MIB,
        description="Size in bytes from which clients read a blob directly from the S3 server, with a signed address "
        "that is valid for a minute. Absent: all bytes pass through this server.",
    )

    @field_validator("s3_bucket")
    @classmethod
    def _check_bucket(cls, bucket: str | None, others: ValidationInfo) -> str | None:
        if bucket is None and others.data.get("blobs") == "s3":
            raise ValueError('blobs = "s3" needs the name of a bucket in s3_bucket')
        return bucket

    @field_validator("s3_endpoint")
    @classmethod
    def _check_endpoint(cls, endpoint: str | None) -> str | None:
        address = urlsplit(endpoint or "https://s3")
        if address.scheme not in ("http", "https") or not address.hostname or "@" in address.netloc:
            raise ValueError("the address must begin with http:// or https:// and must not contain a user or password")
        return endpoint

    @field_validator("s3_secret_key_file")
    @classmethod
    def _check_secret_key_file(cls, file: Path | None, others: ValidationInfo) -> Path | None:
        if (file is None) != (others.data.get("s3_key_id") is None):
            raise ValueError("s3_key_id and s3_secret_key_file are needed together")
        if file is not None and not read_secret(file):
            raise ValueError(f"{file} is empty, but must contain the secret of s3_key_id")
        return file

    @property
    def bucket(self) -> Bucket | None:
        """The address of the bucket for blobs, with its credentials; None if the settings name no bucket."""
        if self.s3_bucket is None:
            return None
        return Bucket(
            self.s3_bucket,
            endpoint=self.s3_endpoint,
            region=self.s3_region,
            prefix=self.s3_prefix,
            key_id=self.s3_key_id,
            secret_key=None if self.s3_secret_key_file is None else read_secret(self.s3_secret_key_file),
            timeout_s=self.s3_timeout_s,
        )
