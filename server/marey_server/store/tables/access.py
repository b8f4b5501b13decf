"""Tables of users, tokens and projects, and of the roles and rights of users in projects."""

from sqlalchemy import BigInteger, Boolean, Column, ForeignKey, Index, Integer, String, Table, Text, false, text

from marey_server.store.tables.columns import ID, Document, Micros, metadata, unique_alive

user = Table(
    "user",
    metadata,
    Column("id", ID, primary_key=True),
    Column("name", String(64), nullable=False, unique=True),
    Column("display_name", String(255)),
    Column("password_hash", Text),
    Column("administrator", Boolean, nullable=False, default=False),
    Column("disabled", Boolean, nullable=False, default=False),
    Column("created_us", Micros, nullable=False),
    Column("rev", Integer, nullable=False, default=1),
    Column("jobs_bound", BigInteger),  # not less than the number of unfinished jobs; null: not counted yet
)

token = Table(
    "token",
    metadata,
    Column("id", ID, primary_key=True),
    Column("user_id", ID, ForeignKey("user.id"), nullable=False, index=True),
    Column("name", String(255), nullable=False),
    Column("prefix", String(16), nullable=False, unique=True),
    Column("secret_hash", String(64), nullable=False),
    Column("scopes", Document, nullable=False),
    Column("created_us", Micros, nullable=False),
    Column("expires_us", Micros),
    Column("last_used_us", Micros),
    Column("session", Boolean, nullable=False, default=False, server_default=false()),  # made by a sign-in
    Column("created_by", ID),  # the token whose bearer created it
    Column("labels", Document),  # that its workers may announce; null: any
    Column("rotation_hash", String(64)),  # hash of the id of the rotation that replaced it
    Column("successor_of", ID),  # the token that it replaced
    Index("uq_token_successor_of", "successor_of", unique=True),
)

identity = Table(  # a person at an identity provider, who signs in as a user
    "identity",
    metadata,
    Column("id", ID, primary_key=True),
    Column("user_id", ID, ForeignKey("user.id"), nullable=False, index=True),
    Column("issuer", String(512), nullable=False),
    Column("subject", String(255), nullable=False),
    Column("created_us", Micros, nullable=False),
    Column("last_used_us", Micros),
    Index("uq_identity_issuer_subject", "issuer", "subject", unique=True),
)

browser_sign_in = Table(  # a sign-in with an identity provider that is not complete; it contains only hashes of secrets
    "browser_sign_in",
    metadata,
    Column("id", ID, primary_key=True),
    Column("challenge", String(64), nullable=False),  # hash of the secret of the program that began it
    Column("port", Integer),  # at which this program waits for the code
    Column("lifetime_s", Integer, nullable=False),  # of the token
    Column("browser_hash", String(64)),  # of the cookie of the browser that opened it
    Column("state_hash", String(64), unique=True),  # of the state that the provider sends back, once
    Column("code_hash", String(64)),  # of the code that the browser got
    Column("identity_id", ID, ForeignKey("identity.id"), index=True),
    Column("created_us", Micros, nullable=False),
    Column("expires_us", Micros, nullable=False, index=True),
)

sign_in_limit = Table(  # sign-ins, and other things that are limited in the same way
    "sign_in_limit",
    metadata,
    Column("key", String(64), primary_key=True),  # hash of a limit's name, and of what it is for
    Column("until_us", Micros, nullable=False, index=True),  # from then on the row says nothing
)

project = Table(
    "project",
    metadata,
    Column("id", ID, primary_key=True),
    Column("name", String(64), nullable=False),
    Column("title", String(255)),
    Column("description", Text, nullable=False, default=""),
    Column("visibility", String(16), nullable=False),
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
    Column("deleted_us", Micros),
    Column("rev", Integer, nullable=False, default=1),
    unique_alive("project", "name"),
)

invitation = Table(
    "invitation",
    metadata,
    Column("id", ID, primary_key=True),
    Column("inviter_id", ID, ForeignKey("user.id"), nullable=False, index=True),
    Column("project_id", ID, ForeignKey("project.id"), index=True),
    Column("role", String(16)),  # in the project
    Column("creates_account", Boolean, nullable=False),
    Column("prefix", String(16), nullable=False, unique=True),
    Column("secret_hash", String(64), nullable=False),
    Column("note", String(255), nullable=False),
    Column("uses", Integer, nullable=False),
    Column("used", Integer, nullable=False),
    Column("created_us", Micros, nullable=False),
    Column("expires_us", Micros, nullable=False, index=True),
)

invitation_use = Table(  # who has used it, so that nobody uses it twice, and a repeated request gets the same answer
    "invitation_use",
    metadata,
    Column("invitation_id", ID, ForeignKey("invitation.id"), primary_key=True),
    Column("user_id", ID, ForeignKey("user.id"), primary_key=True),
)

holding = Table(  # what a project or a user holds, and limits other than those of the settings
    "holding",
    metadata,
    Column("owner_id", ID, primary_key=True),  # of a project, or of a user
    Column("items", BigInteger, nullable=False, default=0, server_default=text("0")),
    Column("stored_bytes", BigInteger, nullable=False, default=0, server_default=text("0")),
    Column("limits", Document, nullable=False),  # by the name of the quota
)

member = Table(
    "member",
    metadata,
    Column("project_id", ID, ForeignKey("project.id"), primary_key=True),
    Column("user_id", ID, ForeignKey("user.id"), primary_key=True, index=True),
    Column("role", String(16), nullable=False),
    Column("since_us", Micros, nullable=False),
    Column("rev", Integer, nullable=False, default=1),
)

folder_role = Table(  # roles in folders, which differ from the role in the project
    "folder_role",
    metadata,
    Column("project_id", ID, ForeignKey("project.id"), primary_key=True),
    Column("user_id", ID, primary_key=True),  # or `EVERY_MEMBER` of marey_schemas.access
    Column("collection_id", ID, ForeignKey("collection.id"), primary_key=True, index=True),
    Column("role", String(16), nullable=False),
    Column("since_us", Micros, nullable=False),
    Column("rev", Integer, nullable=False, default=1),
)
