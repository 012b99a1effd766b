// Wider vectors where the processor has them. Nothing is contracted or reordered, so all versions give the same bits.
//
// Loops in a kernel are plain ones over arrays: the compiler makes vectors of them. Of vector types it makes scalars
// where a function has several versions.
#pragma once

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define RASTER_KERNEL __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define RASTER_KERNEL
#endif
