// Arrays that begin on a cache line, and nodes in them: four numbers a node, of which the fourth is
// zero, so that a node is one vector register.
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <new>
#include <vector>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace sim_core {

// Large arrays lie in large pages where the system has them: a factor is read from end to end, over
// and over.
constexpr std::size_t large_page = std::size_t{1} << 21;

template <class T>
struct CacheAligned {
  using value_type = T;
  CacheAligned() = default;
  template <class U>
  CacheAligned(const CacheAligned<U>&) {}
  static std::align_val_t alignment(std::size_t n) {
    return std::align_val_t{n * sizeof(T) < large_page ? 64 : large_page};
  }
  T* allocate(std::size_t n) {
    void* p = ::operator new(n * sizeof(T), alignment(n));
#ifdef MADV_HUGEPAGE
    if (n * sizeof(T) >= large_page) madvise(p, n * sizeof(T), MADV_HUGEPAGE);
#endif
    return static_cast<T*>(p);
  }
  void deallocate(T* p, std::size_t n) { ::operator delete(p, alignment(n)); }
  friend bool operator==(const CacheAligned&, const CacheAligned&) { return true; }
};
template <class T>
using Buffer = std::vector<T, CacheAligned<T>>;

template <class T>
Eigen::Map<Eigen::Matrix<T, 3, 1>> at_node(Buffer<T>& buffer, int node) {
  return Eigen::Map<Eigen::Matrix<T, 3, 1>>(&buffer[4L * node]);
}
template <class T>
Eigen::Map<const Eigen::Matrix<T, 3, 1>> at_node(const Buffer<T>& buffer, int node) {
  return Eigen::Map<const Eigen::Matrix<T, 3, 1>>(&buffer[4L * node]);
}

}  // namespace sim_core
