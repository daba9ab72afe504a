"""``python -m occdetr.benchmark``: see ``occdetr.benchmark``."""

from occdetr.benchmark import main

if __name__ == "__main__":
    main()
