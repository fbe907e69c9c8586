"""Algorithms to compare the coarse-to-fine policy with.

This package will hold modular policies (message passing, attention), ablations of CFP and gradient-based control
behind the command line of :mod:`cfp`. Nothing public stands here yet.
"""
