"""Tables of the participants of perceptual studies, and of the trials that they were shown."""

from sqlalchemy import Column, Float, ForeignKey, Integer, String, Table, UniqueConstraint

from marey_server.store.tables.columns import ID, Document, Micros, metadata

study_participant = Table(
    "study_participant",
    metadata,
    Column("id", ID, primary_key=True),
    Column("item_id", ID, ForeignKey("item.id"), nullable=False),  # the study
    Column("revision", Integer, nullable=False),  # of the study
    Column("number", Integer, nullable=False),  # among those who see this revision, from 1; it gives the pseudonym
    Column("link_prefix", String(16), nullable=False, unique=True),
    Column("link_hash", String(64), nullable=False),
    Column("token_prefix", String(16), unique=True),  # from here on null until the link is used
    Column("token_hash", String(64)),
    Column("started_us", Micros),  # of the consent
    Column("withdrawn_us", Micros),
    Column("plan", Document, nullable=False),  # the motions of each trial
    Column("answered", Integer, nullable=False, default=0),
    Column("timeouts", Integer, nullable=False, default=0),
    Column("created_us", Micros, nullable=False),
    Column("expires_us", Micros, nullable=False),  # of the link, if nobody uses it
    UniqueConstraint("item_id", "revision", "number"),
)

study_trial = Table(  # as shown: a trial that timed out is one row, and the one that replaces it another
    "study_trial",
    metadata,
    Column("participant_id", ID, ForeignKey("study_participant.id"), primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("shown", Document, nullable=False),  # motions by place on the screen
    Column("answered_before", Integer, nullable=False),
    Column("timeouts_before", Integer, nullable=False),  # since the last answer
    Column("started_us", Micros, nullable=False),
    Column("deadline_us", Micros, nullable=False),
    Column("ended_us", Micros),  # null: it is open
    Column("chosen", Document),  # null: it is open, or nobody answered in time
    Column("client_fps", Float),
)
