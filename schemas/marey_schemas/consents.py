"""Consent of performers: refusals of exports after the end of a consent, and permissions for such exports."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, StringConstraints, model_validator

from marey_schemas.base import Request
from marey_schemas.names import form

CONSENT_EXPIRED = "consent-expired"
"""Code of errors, and of refusals in jobs, for clips that are not exported because their consent has ended."""

CONSENT_REMEDY = (
    "If the performer has agreed to a later day, record that day as `consent_until`. Otherwise, a maintainer of the "
    "project can allow the export with `allow_expired_consent` and a reason."
)

ConsentReason = Annotated[
    str,
    StringConstraints(
        min_length=1,
        max_length=500,
        pattern=form(r"^[^\x00-\x1f\x7f]*\S[^\x00-\x1f\x7f]*$", "be one line that is not blank"),
    ),
]
"""Reason for an export after the end of the consent: one line of text."""


class ConsentOverride(Request):
    """Permission to export clips although the consent for them has ended, with the reason."""

    allow_expired_consent: bool = Field(
        False,
        description="Whether clips are exported although the consent of the performer has ended. Requires the role "
        "maintainer and a reason; an event records both.",
    )
    consent_reason: ConsentReason | None = Field(
        None,
        description="Reason why clips are exported although the consent of the performer has ended; "
        "required with `allow_expired_consent`.",
    )

    @model_validator(mode="after")
    def _check_reason(self) -> Self:
        if self.allow_expired_consent and self.consent_reason is None:
            raise ValueError("consent_reason: give the reason for allow_expired_consent")
        if self.consent_reason is not None and not self.allow_expired_consent:
            raise ValueError("consent_reason: leave it out, or set allow_expired_consent to true")
        return self
