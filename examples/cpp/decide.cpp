// A C++ host of decision.pt2, without Python: the decisions of the self-test, compared with those of Python and timed.
//
// decide <export folder>
//
// A vehicle builds the arguments itself; export.json names them and the results in order, docs/deployment.md has their
// shapes.

#include <ATen/Parallel.h>
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>
#include <torch/script.h>

#include <algorithm>
#include <cstdio>
#include <ctime>
#include <exception>
#include <fstream>
#include <iterator>
#include <string>
#include <vector>

constexpr double kTolerance = 1e-4;  // m, m/s, rad: what another processor's rounding may make

// [[arguments, results], ...] of decision_selftest.pt.
static c10::List<c10::IValue> read(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path + " must be a file that can be read");
  const std::vector<char> bytes((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
  return torch::jit::pickle_load(bytes).toList();
}

static std::vector<at::Tensor> tensors(const c10::IValue& list) {
  std::vector<at::Tensor> found;
  for (const c10::IValue& each : list.toList()) found.push_back(each.toTensor());
  return found;
}

static int run(const std::string& folder) {
  const c10::InferenceMode mode;
  at::set_num_threads(1);
  torch::inductor::AOTIModelPackageLoader decide(folder + "/decision.pt2", "model", /*run_single_threaded=*/true);
  std::vector<double> milliseconds;
  double largest = 0.0;
  int n_other = 0;
  for (const c10::IValue& decision : read(folder + "/decision_selftest.pt")) {
    const auto both = decision.toList();
    const auto arguments = tensors(both.get(0)), expected = tensors(both.get(1));
    const std::clock_t began = std::clock();
    const auto found = decide.run(arguments);
    milliseconds.push_back(1e3 * static_cast<double>(std::clock() - began) / CLOCKS_PER_SEC);
    // results: horizon, action, logits, trajectory, ...
    n_other += !found.at(0).equal(expected.at(0));
    largest = std::max(largest, (found.at(3) - expected.at(3)).abs().max().item<double>());
    std::printf("horizon %4g s, after 0.2 s at (%.3f, %.3f) m with %.3f m/s\n", found[0].item<double>(),
                found[3][0][0].item<double>(), found[3][0][1].item<double>(), found[3][0][3].item<double>());
  }
  std::sort(milliseconds.begin(), milliseconds.end());
  std::printf("%zu decisions, %d with another horizon, trajectories within %.2g of Python's, %.2f ms of CPU time\n",
              milliseconds.size(), n_other, largest, milliseconds.at(milliseconds.size() / 2));
  return n_other == 0 && largest <= kTolerance ? 0 : 1;
}

int main(int n_arguments, char** arguments) {
  if (n_arguments != 2) {
    std::fprintf(stderr, "usage: decide <export folder>\n");
    return 2;
  }
  try {
    return run(arguments[1]);
  } catch (const c10::Error& error) {
    std::fprintf(stderr, "%s\n", error.what_without_backtrace());
    return 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
