"""How kernels are compiled, kept and launched, on which threads and on which device."""
