"""Progress that remembers what it was told."""

from geogs.application.progress.run_progress import RunProgress


class Listener(RunProgress):
    """Remembers what it was told."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.stages: set[str] = set()

    def write(self, text: str) -> None:
        self.said.append(text)

    def stage(self, name: str, fraction: float) -> None:
        self.stages.add(name)
