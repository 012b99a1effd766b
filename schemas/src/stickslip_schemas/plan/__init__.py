"""How a spec becomes samples with content keys."""
