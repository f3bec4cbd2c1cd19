"""Tests of the package; helpers that tests share are in `test.support`."""
