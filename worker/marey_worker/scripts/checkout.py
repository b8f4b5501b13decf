"""Checkout of a pinned commit from a cache of Git repositories.

Git runs without a shell, hooks, submodules, filters, credentials and configuration of the user.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import resource
import shutil
import subprocess
import tarfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from marey_schemas.queue.scripts import ScriptDeclaration, is_allowed, read_repositories
from marey_schemas.sizes import GIB, MIB
from marey_worker.context import JobRefused

FETCH_S = 600
"""Greatest number of seconds of one Git command."""
CACHE_BYTES = 2 * GIB
"""Size of the cache of repositories above which those that were used longest ago are deleted."""
MOST_REPOSITORY_BYTES = GIB
"""Greatest size of one file that Git may write, and so of one pack."""
MOST_CHECKOUT_BYTES = 512 * MIB
MOST_CHECKOUT_FILES = 50_000
_SETTINGS = (
    "core.hooksPath=/dev/null", "credential.helper=", "fetch.fsckObjects=true", "submodule.recurse=false",
    "http.followRedirects=false", "http.lowSpeedLimit=1000", "http.lowSpeedTime=60", "gc.auto=0",
    "protocol.version=2",
)  # fmt: skip


class FetchFailed(Exception):
    """Error of a repository that could not be read; a retry may succeed."""

    code = "script-fetch-failed"


def check_out(declared: ScriptDeclaration, folder: Path, environment: Mapping[str, str]) -> None:
    """Write the files of a script's commit to `folder`, from the cache or from the repository.

    Raises `JobRefused` if this worker has no Git or does not allow the repository, if no branch or tag of it contains
    the commit, or if the commit is too large or has a file or link that leads out of `folder`. Raises `FetchFailed` if
    the repository cannot be read now.
    """
    if not is_allowed(declared.repository, read_repositories(environment)):
        detail = f"this worker does not allow the repository {declared.repository}"
        raise JobRefused("repository-not-allowed", detail)
    cache = _cache_folder(environment)
    repository = cache / f"{hashlib.sha256(declared.repository.encode()).hexdigest()[:32]}.git"
    with _locked(repository, fcntl.LOCK_EX):
        git = _Git(repository, declared.repository, environment)
        if not git.contains(declared.commit):
            git.fetch()
            if not git.contains(declared.commit):
                raise JobRefused(
                    "no-commit",
                    f"no branch or tag of {declared.repository} contains the commit {declared.commit}; push the "
                    "commit, or register the script with another one",
                )
        git.extract(declared.commit, folder)
        os.utime(repository)
    _shrink(cache, repository)


class _Git:
    """Bare copy of a repository, and the Git commands that read it."""

    def __init__(self, folder: Path, url: str, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._url = url
        self._environment = {
            "PATH": environment.get("PATH", os.defpath),
            "LC_ALL": "C",
            "HOME": os.devnull,
            "GIT_CONFIG_NOSYSTEM": "1",
            "GIT_CONFIG_GLOBAL": os.devnull,
            "GIT_TERMINAL_PROMPT": "0",
            "GIT_ASKPASS": "true",
            "GIT_ALLOW_PROTOCOL": url.partition(":")[0],
            "GIT_LFS_SKIP_SMUDGE": "1",
        }

    def contains(self, commit: str) -> bool:
        """Return whether a branch or tag of the copy contains the commit.

        Large hosts also serve the commits of forks under the address of the original repository. So a commit that the
        host can serve is not necessarily a commit of the repository.
        """
        if not self._folder.exists():
            return False
        found = self._run("for-each-ref", "--count=1", f"--contains={commit}", "refs/heads", "refs/tags", check=False)
        return found.returncode == 0 and bool(found.stdout.strip())

    def fetch(self) -> None:
        """Fetch all branches and tags of the repository. Raises `FetchFailed` if this fails."""
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        for left in (*self._folder.rglob("*.lock"), *self._folder.glob("objects/**/tmp_*")):
            left.unlink()  # of a Git command that was killed; no other one runs, because this worker holds the lock
        self._run("init", "--quiet", "--bare", str(self._folder))
        refs = ("+refs/heads/*:refs/heads/*", "+refs/tags/*:refs/tags/*")
        options = ("--quiet", "--prune", "--no-tags", "--no-recurse-submodules", "--no-write-fetch-head")
        self._run("fetch", *options, "--", self._url, *refs)

    def extract(self, commit: str, folder: Path) -> None:
        """Write the files of a commit to `folder`.

        Raises `JobRefused` if the commit is too large, or if a file or link in it leads out of the folder.
        """
        command = self._command("archive", "--format=tar", commit)
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=self._environment) as git:  # noqa: S603 - a list without a shell
            assert git.stdout is not None
            try:
                _unpack(git.stdout, folder)
            finally:
                git.kill()

    def _run(self, *words: str, check: bool = True) -> subprocess.CompletedProcess[bytes]:
        try:
            done = subprocess.run(  # noqa: S603 - a list without a shell
                self._command(*words),
                env=self._environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=FETCH_S,
                check=False,
                preexec_fn=_limit_files,
            )
        except FileNotFoundError as error:
            raise JobRefused("no-git", "this worker has no program `git`; install it") from error
        except subprocess.TimeoutExpired as error:
            raise FetchFailed(f"git {words[0]} of {self._url} took longer than {FETCH_S} s") from error
        if check and done.returncode != 0:
            said = done.stderr.decode("utf-8", "replace").strip()[-500:]
            raise FetchFailed(f"git {words[0]} of {self._url} failed: {said}")
        return done

    def _command(self, *words: str) -> list[str]:
        settings = [word for setting in _SETTINGS for word in ("-c", setting)]
        return ["git", f"--git-dir={self._folder}", *settings, *words]


def _limit_files() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (MOST_REPOSITORY_BYTES, MOST_REPOSITORY_BYTES))


def _unpack(stream: IO[bytes], folder: Path) -> None:
    total = 0
    try:
        with tarfile.open(fileobj=stream, mode="r|") as archive:
            for count, member in enumerate(archive):
                total += member.size
                if total > MOST_CHECKOUT_BYTES or count >= MOST_CHECKOUT_FILES:
                    detail = f"it has more than {MOST_CHECKOUT_FILES:,} files or {MOST_CHECKOUT_BYTES // MIB} MiB"
                    raise JobRefused("commit-too-large", f"the commit is too large: {detail}")
                archive.extract(member, folder, filter="data")
    except tarfile.FilterError as error:
        raise JobRefused("unsafe-commit", f"a file or link of the commit leads out of its folder: {error}") from error
    except tarfile.TarError as error:
        raise FetchFailed(f"the files of the commit cannot be read: {error}") from error


# -- the cache --


def _cache_folder(environment: Mapping[str, str]) -> Path:
    """Return the folder of the cache of repositories, below `XDG_CACHE_HOME` or `~/.cache`."""
    return Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "marey" / "scripts"


@contextmanager
def _locked(repository: Path, how: int) -> Iterator[bool]:
    """Hold the lock of a cached repository while the `with` block runs, and yield true.

    `how` is a mode of `fcntl.flock`. If it does not wait, and another worker holds the lock, yield false.
    """
    repository.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with repository.with_suffix(".lock").open("ab") as lock:
        try:
            fcntl.flock(lock, how)
        except BlockingIOError:
            yield False
            return
        yield True


def _shrink(cache: Path, used: Path) -> None:
    """Delete the least recently used repositories, but not `used`, until the cache is at most `CACHE_BYTES` large.

    Repositories that another worker uses at the moment are kept.
    """
    sizes = {one: sum(file.lstat().st_size for file in one.rglob("*")) for one in cache.glob("*.git")}
    total = sum(sizes.values())
    for one in sorted(sizes, key=lambda path: path.stat().st_mtime):
        if total <= CACHE_BYTES or one == used:
            continue
        with _locked(one, fcntl.LOCK_EX | fcntl.LOCK_NB) as held:
            if held:
                shutil.rmtree(one)
                total -= sizes[one]
