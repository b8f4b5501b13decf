"""Poses of stored motions: arrays, tables, pictures, and windows for training."""
