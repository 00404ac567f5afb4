"""How far `infer` is, on standard error."""


class ProgressBar:
    """A bar of blocks that are done and what is being done; nothing unless asked for.

    Args:
        is_shown: whether to show it.
        num_blocks: how many there are.
    """

    def __init__(self, is_shown: bool, num_blocks: int):
        self._bar = None
        if is_shown:
            from tqdm import tqdm

            self._bar = tqdm(total=num_blocks, unit="block", desc="infer")

    def stage(self, name: str) -> None:
        """Say what is being done."""
        if self._bar is not None:
            self._bar.set_postfix_str(name)

    def advance(self, num: int) -> None:
        """So many blocks are done."""
        if self._bar is not None:
            self._bar.update(num)

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
