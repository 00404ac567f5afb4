"""Errors that one member of a batch is to blame for, which say which."""

import contextlib
from collections.abc import Generator, Mapping

# So many members are named.
_MOST_NAMED = 10


class MemberError(ValueError):
    """Members of a batch cannot be inferred; found before any of them is."""

    messages: dict[int, str]
    """By number of the member, without that number."""

    def __init__(self, text: str, messages: Mapping[int, str] | None = None):
        # All else that makes up an exception follows from its text when it is sent to
        # another process.
        super().__init__(text)
        self.messages = dict(messages or {})


class Refusals:
    """What is wrong with members of a batch, collected so that all are looked at."""

    def __init__(self, num_members: int):
        self._num_members = num_members
        self._errors: dict[int, ValueError] = {}

    @contextlib.contextmanager
    def of(self, index: int) -> Generator[None, None, None]:
        """Keep a ValueError that is about a member of this number."""
        try:
            yield
        except ValueError as error:
            self._errors.setdefault(index, error)

    def check(self) -> None:
        """Raise if there was anything.

        Raises:
            MemberError: with the first message; it names the member unless there is
                only one, and the others of which there is something to say.
        """
        if not self._errors:
            return
        messages = {index: str(error) for index, error in self._errors.items()}
        first, *others = messages
        text = messages[first]
        if self._num_members > 1:
            text = f"object {first}: {text}"
        if others:
            text = f"{text}; refused as well: {named_objects(others)}"
        raise MemberError(text, messages) from self._errors[first]


@contextlib.contextmanager
def naming(index: int, num_members: int) -> Generator[None, None, None]:
    """Put the number of a member in front of what is wrong with it, if it has others.

    Args:
        index: its number.
        num_members: how many there are.

    Raises:
        TypeError: one was raised inside.
        ValueError: one was raised inside.
    """
    try:
        yield
    except (TypeError, ValueError) as error:
        if num_members == 1:
            raise
        kind = ValueError if isinstance(error, ValueError) else TypeError
        raise kind(f"object {index}: {error}") from error


def named_objects(numbers: list[int]) -> str:
    """Numbers of objects in words, at most ten of them."""
    listed = ", ".join(map(str, numbers[:_MOST_NAMED]))
    word = "object" if len(numbers) == 1 else "objects"
    more = len(numbers) - _MOST_NAMED
    return f"{word} {listed}" + (f" and {more} more" if more > 0 else "")
