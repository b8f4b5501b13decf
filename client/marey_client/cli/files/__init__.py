"""Commands about files and items: `upload`, `ls`, `show` and `download`."""
