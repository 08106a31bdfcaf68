"""``python -m skin`` is ``skin``."""

from skin.cli import main

if __name__ == "__main__":
    main()
