"""From uploaded files to documents of skeletons, clips, and models. Bytes in, documents out."""
