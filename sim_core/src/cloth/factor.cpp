#include "cloth/factor.hpp"

#include <algorithm>
#include <cmath>

namespace sim_core {

StaleFactor::StaleFactor(const Numbering& numbering)
    : storage_(numbering.compact_bending, numbering.membrane, numbering.dissection),
      view_(storage_.view()),
      added_(6L * numbering.free_nodes, 0.0f),
      touched_(numbering.free_nodes, 0) {}

double StaleFactor::renew(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, double dt,
                          const ClothSettings& settings) {
  if (!made_ || cost_.too_much(settings)) {
    make(assembly, x, contact, dt);
    return 1.0;
  }
  if (contact.mode == modes_) return 0.0;
  for (std::size_t i = 0; i < touched_.size(); ++i) touched_[i] = contact.mode[i] != modes_[i];
  const double share = storage_.mark(touched_);
  refresh(assembly, contact);
  return share;
}

void StaleFactor::make(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, double dt) {
  storage_.mark_all();
  matrix_ = assembly.neighbour(x, numbers_);
  refresh(assembly, contact);
  made_ = true;
  dt_ = dt;
  cost_.restart();
}

void StaleFactor::refresh(const Assembly& assembly, const ContactState& contact) {
  for (int i = 0; i < assembly.numbering.free_nodes; ++i)
    contact.penalty(i, assembly.own_stiffness(i), &added_[6L * i]);
  assembly.kernel.factor(view_, matrix_, added_.data());
  modes_ = contact.mode;
}

void FactorCost::spent(int iterations) {
  last_ = iterations;
  if (fresh_ < 0) fresh_ = last_, excess_ = 0;
  excess_ += std::max(0, last_ - fresh_);
}

bool StaleFactor::fits(double dt) const { return made_ && std::abs(dt - dt_) <= 1e-9 * dt_; }

FactorPool::FactorPool(const Numbering& numbering, int size) : numbering_(numbering), size_(size) {
  factors_.push_back(std::make_unique<StaleFactor>(numbering));
}

StaleFactor& FactorPool::of(double dt) {
  std::size_t place = 0;
  while (place < factors_.size() && !factors_[place]->fits(dt)) ++place;
  if (place == factors_.size()) {
    if (place < size_) {
      factors_.push_back(std::make_unique<StaleFactor>(numbering_));
    } else {
      --place;
      factors_[place]->forget();
    }
  }
  std::rotate(factors_.begin(), factors_.begin() + place, factors_.begin() + place + 1);
  return *factors_.front();
}

}  // namespace sim_core
