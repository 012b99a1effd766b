"""Requests to coordinators, servers of datasets and buckets: addresses, proxies, keys, limits."""
