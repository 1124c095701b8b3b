# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The SQLite file under a catalogue: opened, asked and changed, with errors in words."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ofsat_ros.catalog.schema import APPLICATION_ID, SCHEMA, VERSION

# How long another process may be writing, s.
_PATIENCE_S = 10.0


class CatalogError(ValueError):
    """A file that cannot be used as a catalogue; the message says why, and what to do."""


class Storage:
    """An open file with the tables of schema.py.

    Parameters
    ----------
    path : Path
    write : bool
        Whether to change it; where there is none, an empty one is made.

    Raises
    ------
    CatalogError
        If it cannot be used.
    """

    def __init__(self, path: Path, write: bool) -> None:
        self._path = path
        uri = f"{path.absolute().as_uri()}?mode={'rwc' if write else 'ro'}"
        with self._told():
            self._file = sqlite3.connect(uri, _PATIENCE_S, isolation_level=None, uri=True)
        try:
            with self._told():
                self._start(write)
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close it."""
        self._file.close()

    def ask(self, sql: str, needs: Any = ()) -> list[sqlite3.Row]:
        """Return the rows that answer a question."""
        with self._told():
            return self._file.execute(sql, needs).fetchall()

    @contextmanager
    def change(self) -> Iterator[sqlite3.Connection]:
        """Have all that is done to the connection come true at the end, or nothing of it.

        Raises
        ------
        CatalogError
            If the file cannot be written.
        sqlite3.IntegrityError
            If rows contradict each other.
        """
        with self._told():
            self._file.execute("BEGIN IMMEDIATE")
            try:
                yield self._file
                self._file.execute("COMMIT")
            except BaseException:
                if self._file.in_transaction:
                    self._file.execute("ROLLBACK")
                raise

    def _start(self, write: bool) -> None:
        ask, path = self.ask, self._path
        if write and not ask("SELECT 1 FROM sqlite_master"):
            marks = f"PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {VERSION};"
            self._file.executescript(f"BEGIN IMMEDIATE; {SCHEMA} {marks} COMMIT;")
        ((application,),) = ask("PRAGMA application_id")
        ((version,),) = ask("PRAGMA user_version")
        if application != APPLICATION_ID:
            raise CatalogError(f"{path} is no catalogue of ofsat: give another file")
        if version != VERSION:
            other = "a newer" if version > VERSION else "an older"
            raise CatalogError(
                f"{path} was made by {other} version of ofsat (its tables are {version}, this"
                f" version's {VERSION}): use that version, or {_anew(path)}"
            )
        self._file.execute("PRAGMA foreign_keys = ON")
        self._file.create_function("casefold", 1, str.casefold, deterministic=True)
        self._file.row_factory = sqlite3.Row

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Have errors of SQLite say what to do."""
        try:
            yield
        except sqlite3.IntegrityError:
            raise
        except sqlite3.Error as error:
            raise CatalogError(f"{self._path} {self._in_words(error)}") from error

    def _in_words(self, error: sqlite3.Error) -> str:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            return "is being written by another process: try again when that has ended"
        if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
            return f"is damaged ({error}): {_anew(self._path)}"
        if code == sqlite3.SQLITE_READONLY:
            return "cannot be written: see to its permissions, or give another place"
        return f"cannot be used: {error}"


def _anew(path: Path) -> str:
    return (
        f"delete it, and make it anew of the results' folders: `ofsat catalog {path} --add FOLDER`"
    )
