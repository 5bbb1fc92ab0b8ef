"""Golden flights: digests of flights, so that tests detect every change.

After an intended change, renew the digests with `make golden` and give the reason in the changelog.
"""
