"""The command ``flashdex``, also ``python -m flashdex.cli``."""

from flashdex.cli.interrupt import loading


def start() -> int:
    """Run the command; Ctrl-C is heard from its first moment."""
    with loading():
        from flashdex.cli.main import main
    return main()


if __name__ == "__main__":
    raise SystemExit(start())
