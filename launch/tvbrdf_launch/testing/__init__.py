"""For tests of nodes and rigs, users' and the project's own: see ``docs/testing.md``.

``plugin.py`` gives pytest the fixtures ``rig``, ``bag`` and ``graph``; what they return is in
``rigs.py``, ``bags.py`` and ``graphs.py``, and works without pytest too. Nothing is loaded here:
tests that use none of it pay for none of it.
"""
