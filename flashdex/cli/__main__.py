"""``python -m flashdex.cli`` is the command ``flashdex``."""

from flashdex.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
