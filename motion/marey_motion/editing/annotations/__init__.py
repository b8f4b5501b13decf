"""Layers of segments and keyframes over clips: changed by commands, proposed by algorithms."""
