// The linear problem of contact: what is admissible, and the product with its matrix.
#pragma once

#include "cloth/kernels/matrix.hpp"

namespace sim_core {
namespace {

// Sets to zero what contact forbids: the normal part where a node slips, all where it sticks.
inline void admit(const ContactRows& contact, int nodes, float* v) {
  for (int i = 0; i < nodes; ++i) {
    Node* at = reinterpret_cast<Node*>(v) + i;
    if (contact.mode[i] == contact_stick) {
      *at = Node{};
    } else if (contact.mode[i] == contact_slip) {
      const Node n = *(reinterpret_cast<const Node*>(contact.normal) + i);
      *at -= spread(dot3(n, *at)) * n;
    }
  }
}

// y = J v for an admissible v: a slipping node's friction follows its normal force and turns with its motion.
inline void apply_contact(const ClothMatrix& matrix, const ContactRows& contact, const float* v, float* y) {
  apply_rows(matrix, contact.mode, v, y);
  for (int i = 0; i < matrix.nodes; ++i) {
    Node* at = reinterpret_cast<Node*>(y) + i;
    if (contact.mode[i] == contact_stick) {
      *at = Node{};
    } else if (contact.mode[i] == contact_slip) {
      const Node n = *(reinterpret_cast<const Node*>(contact.normal) + i);
      const Node t = *(reinterpret_cast<const Node*>(contact.direction) + i);
      const Node own = *(reinterpret_cast<const Node*>(v) + i);
      const float normal = dot3(n, *at);
      *at -= spread(normal) * n;
      *at += spread(contact.turning[i]) * (own - spread(dot3(t, own)) * t) - spread(contact.mu[i] * normal) * t;
    }
  }
}

}  // namespace
}  // namespace sim_core
