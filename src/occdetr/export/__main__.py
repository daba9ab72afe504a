"""``python -m occdetr.export``: see ``occdetr.export``."""

from occdetr.export import main

if __name__ == "__main__":
    main()
