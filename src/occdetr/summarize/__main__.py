"""``python -m occdetr.summarize``: see ``occdetr.summarize``."""

from occdetr.summarize import main

if __name__ == "__main__":
    main()
