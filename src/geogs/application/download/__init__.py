"""Public sequences: which are known, fetched with resumption, unpacked safely."""
