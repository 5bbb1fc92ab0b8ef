"""Golden flights: digests of what flights do, so that no change of them goes unnoticed.

Whoever changes flights on purpose makes the digests anew by `make golden`, and the changelog says
why.
"""
