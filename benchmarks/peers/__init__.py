"""The same work done by zscout and by others that lock, reserve or schedule. See docs/evaluation/peers.md."""
