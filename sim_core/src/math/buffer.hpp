// Arrays that begin on a cache line, and nodes in them: four numbers a node, of which the fourth is zero, so that a
// node is one vector register.
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <new>
#include <vector>

namespace sim_core {

template <class T>
struct CacheAligned {
  using value_type = T;
  static constexpr std::align_val_t alignment{64};
  CacheAligned() = default;
  template <class U>
  CacheAligned(const CacheAligned<U>&) {}
  T* allocate(std::size_t n) { return static_cast<T*>(::operator new(n * sizeof(T), alignment)); }
  void deallocate(T* p, std::size_t) { ::operator delete(p, alignment); }
  friend bool operator==(const CacheAligned&, const CacheAligned&) { return true; }
};
template <class T>
using Buffer = std::vector<T, CacheAligned<T>>;

inline Eigen::Map<Eigen::Vector3d> at_node(Buffer<double>& buffer, int node) {
  return Eigen::Map<Eigen::Vector3d>(&buffer[4L * node]);
}
inline Eigen::Map<const Eigen::Vector3d> at_node(const Buffer<double>& buffer, int node) {
  return Eigen::Map<const Eigen::Vector3d>(&buffer[4L * node]);
}
inline Eigen::Map<Eigen::Vector3f> at_node(Buffer<float>& buffer, int node) {
  return Eigen::Map<Eigen::Vector3f>(&buffer[4L * node]);
}
inline Eigen::Map<const Eigen::Vector3f> at_node(const Buffer<float>& buffer, int node) {
  return Eigen::Map<const Eigen::Vector3f>(&buffer[4L * node]);
}

}  // namespace sim_core
