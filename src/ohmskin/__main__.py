"""The start of the command ``ohmskin`` and of ``python -m ohmskin``: handles signals, then imports the rest."""

from __future__ import annotations

from .common import signals


def main() -> None:
    """Run the command line and exit. An interrupt is one line from the first moment, also while modules are loaded."""
    signals.leave_at_once()
    from .cli import main as run

    run()


if __name__ == "__main__":
    main()
