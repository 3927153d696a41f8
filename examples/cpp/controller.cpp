// Run a delayrl policy bundle in C++17, without dependencies: weights and JSON in, actions out.
//
//   g++ -std=c++17 -O3 -march=native -o controller controller.cpp
//   ./controller BUNDLE                 lines of  age obs[S] actions[Δ·A]  on stdin, lines of  action[A]  on stdout
//   ./controller BUNDLE --latency N AGE N decisions at an age, ms: p50 p99 max, p99 of processor time
//
// Units are the task's own. `actions` are those applied since the observation was made, oldest first; entries after the
// first `age` are ignored. The policy is stateless: keep the history yourself, by counting the actions that were applied.
// The program reads bundle.json and policy.safetensors of format 1. It checks shapes, but no SHA-256 sums: check a bundle
// from a network with load_bundle in Python first.

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <map>
#include <random>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

using Floats = std::vector<float>;

[[noreturn]] void refuse(const std::string& why) { throw std::runtime_error(why); }

// ---- JSON --------------------------------------------------------------------------------------------------------

struct Json {
    enum Kind { null, boolean, number, text, list, object } kind = null;
    double value = 0;
    std::string string;
    std::vector<Json> items;
    std::map<std::string, Json> members;

    const Json& at(const std::string& name) const {
        auto member = members.find(name);
        if (member == members.end()) refuse("the bundle lacks \"" + name + "\"");
        return member->second;
    }
    std::size_t integer(double least, double most) const {
        if (kind != number || !(value >= least && value <= most) || value != std::floor(value))
            refuse("the bundle has a number out of range");
        return static_cast<std::size_t>(value);
    }
    std::vector<std::size_t> integers(double most) const {
        std::vector<std::size_t> values;
        for (const Json& item : items) values.push_back(item.integer(0, most));
        return values;
    }
};

class Parser {
   public:
    explicit Parser(const std::string& text) : at_(text.data()), end_(text.data() + text.size()) {}

    Json document() {
        Json value = parse(0);
        space();
        if (at_ != end_) refuse("something follows the JSON");
        return value;
    }

   private:
    const char *at_, *end_;

    void space() {
        while (at_ != end_ && (*at_ == ' ' || *at_ == '\n' || *at_ == '\r' || *at_ == '\t')) ++at_;
    }
    bool accept(const char* word) {
        std::size_t length = std::strlen(word);
        if (static_cast<std::size_t>(end_ - at_) < length || std::memcmp(at_, word, length) != 0) return false;
        at_ += length;
        return true;
    }
    void expect(const char* word) {
        space();
        if (!accept(word)) refuse("damaged JSON");
    }
    std::string text() {
        expect("\"");
        std::string text;
        while (at_ != end_ && *at_ != '"') {
            if (*at_ == '\\') {  // the names and values that we need have no escapes: keep others as they are
                text += *at_++;
                if (at_ == end_) break;
            }
            text += *at_++;
        }
        expect("\"");
        return text;
    }
    Json parse(int depth) {
        if (depth > 20) refuse("JSON is nested too deeply");
        space();
        Json node;
        if (at_ == end_) refuse("the JSON ends too early");
        if (*at_ == '{') {
            node.kind = Json::object;
            ++at_;
            space();
            if (accept("}")) return node;
            do {
                space();
                std::string name = text();
                expect(":");
                if (!node.members.emplace(name, parse(depth + 1)).second) refuse("a name occurs twice in the JSON");
                space();
            } while (accept(","));
            expect("}");
        } else if (*at_ == '[') {
            node.kind = Json::list;
            ++at_;
            space();
            if (accept("]")) return node;
            do {
                node.items.push_back(parse(depth + 1));
                space();
            } while (accept(","));
            expect("]");
        } else if (*at_ == '"') {
            node.kind = Json::text;
            node.string = text();
        } else if (accept("true") || accept("false")) {
            node.kind = Json::boolean;
        } else if (accept("null")) {
            node.kind = Json::null;
        } else {
            const char* start = at_;
            while (at_ != end_ && *at_ != 0 && std::strchr("0123456789+-.eE", *at_)) ++at_;
            std::string digits(start, at_);
            char* rest = nullptr;
            node.kind = Json::number;
            node.value = std::strtod(digits.c_str(), &rest);
            if (digits.empty() || *rest != 0 || !std::isfinite(node.value)) refuse("damaged number in the JSON");
        }
        return node;
    }
};

// ---- Files -------------------------------------------------------------------------------------------------------

std::string contents(const std::string& path, std::size_t limit) {
    std::ifstream file(path, std::ios::binary | std::ios::ate);
    if (!file || !std::filesystem::is_regular_file(path)) refuse("cannot read " + path);
    std::streamoff size = file.tellg();
    if (size < 0 || static_cast<std::size_t>(size) > limit) refuse(path + " is too large");
    std::string data(static_cast<std::size_t>(size), 0);
    file.seekg(0);
    if (!file.read(data.data(), size)) refuse("cannot read " + path);
    return data;
}

// safetensors: 8 bytes with the header's length, a JSON header with types, shapes and offsets, then the numbers.
class Weights {
   public:
    explicit Weights(const std::string& path) : data_(contents(path, std::size_t{1} << 30)) {
        std::uint64_t length = 0;
        if (data_.size() < 8) refuse(path + " is cut");
        std::memcpy(&length, data_.data(), 8);  // little-endian, as x86 and ARM are
        if (length > data_.size() - 8 || length > (1u << 20)) refuse(path + " has no such header");
        header_ = Parser(data_.substr(8, length)).document();
        first_ = 8 + length;
    }

    Floats take(const std::string& name, const std::vector<std::size_t>& shape) const {
        const Json& entry = header_.at(name);
        std::vector<std::size_t> offsets = entry.at("data_offsets").integers(1 << 30);
        std::size_t count = 1;
        for (std::size_t size : shape) count *= size;  // cannot overflow, because the sizes were checked
        if (entry.at("dtype").string != "F32" || entry.at("shape").integers(1 << 30) != shape || offsets.size() != 2 ||
            offsets[1] < offsets[0] || offsets[1] - offsets[0] != 4 * count || offsets[1] > data_.size() - first_)
            refuse("the array " + name + " is not as the bundle describes it");
        Floats values(count);
        std::memcpy(values.data(), data_.data() + first_ + offsets[0], 4 * count);
        for (float value : values)
            if (!std::isfinite(value)) refuse("the array " + name + " holds a number that is not finite");
        return values;
    }

   private:
    std::string data_;
    Json header_;
    std::size_t first_ = 0;
};

// ---- Networks ----------------------------------------------------------------------------------------------------

struct Layer {
    std::size_t inputs, outputs;
    Floats w, b;
};

// [rows, inputs] -> [rows, outputs]: x w + b, four rows at once, which reads w a quarter as often
Floats linear(const Layer& layer, const Floats& x, std::size_t rows) {
    const std::size_t n = layer.outputs;
    Floats y(rows * n);
    for (std::size_t r = 0; r < rows; ++r) std::copy(layer.b.begin(), layer.b.end(), y.begin() + r * n);
    std::size_t r = 0;
    for (; r + 4 <= rows; r += 4) {
        float *y0 = &y[r * n], *y1 = y0 + n, *y2 = y1 + n, *y3 = y2 + n;
        const float* in = &x[r * layer.inputs];
        for (std::size_t k = 0; k < layer.inputs; ++k) {
            const float* w = &layer.w[k * n];
            const float x0 = in[k], x1 = in[layer.inputs + k], x2 = in[2 * layer.inputs + k], x3 = in[3 * layer.inputs + k];
            for (std::size_t j = 0; j < n; ++j) {
                y0[j] += x0 * w[j];
                y1[j] += x1 * w[j];
                y2[j] += x2 * w[j];
                y3[j] += x3 * w[j];
            }
        }
    }
    for (; r < rows; ++r)
        for (std::size_t k = 0; k < layer.inputs; ++k) {
            const float *w = &layer.w[k * n], value = x[r * layer.inputs + k];
            for (std::size_t j = 0; j < n; ++j) y[r * n + j] += value * w[j];
        }
    return y;
}

using Mlp = std::vector<Layer>;

struct Norm {
    Floats scale, shift;

    Floats operator()(Floats x) const {
        const std::size_t width = scale.size();
        for (std::size_t row = 0; row < x.size(); row += width) {
            double mean = 0, variance = 0;
            for (std::size_t j = 0; j < width; ++j) mean += x[row + j];
            mean /= width;
            for (std::size_t j = 0; j < width; ++j) variance += (x[row + j] - mean) * (x[row + j] - mean);
            const double factor = 1 / std::sqrt(variance / width + 1e-5);
            for (std::size_t j = 0; j < width; ++j)
                x[row + j] = static_cast<float>((x[row + j] - mean) * factor) * scale[j] + shift[j];
        }
        return x;
    }
};

// ReLU between the layers, and layer norms before it if there are any
Floats mlp(const Mlp& layers, Floats x, const std::vector<Norm>& norms = {}) {
    for (std::size_t i = 0; i < layers.size(); ++i) {
        x = linear(layers[i], x, 1);
        if (i < norms.size()) x = norms[i](std::move(x));
        if (i + 1 < layers.size())
            for (float& value : x) value = std::max(value, 0.0f);
    }
    return x;
}

// One attention head: query·key is x M x' + c·x', up to terms that cancel in the softmax; value and output are one matrix.
struct Block {
    Norm norm1, norm2;
    Layer attend, value, first, second;
};

// ---- The policy --------------------------------------------------------------------------------------------------

class Policy {
   public:
    explicit Policy(const std::string& folder) {
        const Json bundle = Parser(contents(folder + "/bundle.json", std::size_t{1} << 20)).document();
        if (bundle.at("format").integer(0, 1e9) != 1) refuse("the bundle has another format than 1");
        const Json& described = bundle.at("policy");
        obs_size = described.at("obs_size").integer(1, 1e6);
        action_size = described.at("action_size").integer(1, 1e6);
        max_age = described.at("max_age").integer(0, 1e4);
        if (max_age * action_size > 10000000) refuse("the action history is too large");
        low_ = numbers(described.at("low"));
        high_ = numbers(described.at("high"));
        if (low_.size() != action_size || high_.size() != action_size) refuse("low and high are not as long as an action");
        for (std::size_t j = 0; j < action_size; ++j)
            if (!(low_[j] < high_[j]) || !std::isfinite(high_[j] - low_[j])) refuse("low must lie below high, both finite");
        input_ = described.at("input").string;
        const std::size_t width = described.at("width").integer(0, 1e6), blocks = described.at("blocks").integer(0, 1000);

        const Weights weights(folder + "/policy.safetensors");
        const std::size_t augmented = obs_size + max_age * action_size + 1;
        std::size_t read = obs_size;
        if (input_ != "observation" && max_age == 0) refuse("the policy's input needs an age");
        if (input_ == "augmented")
            read = augmented;
        else if (input_ == "transformer")
            read = width;
        else if (input_ != "observation" && input_ != "forecast")
            refuse("the policy reads an input that this program does not support");
        head_ = network(weights, "head", read, described.at("hidden"), action_size);
        if (described.at("current").kind == Json::list)
            current_ = network(weights, "current", obs_size, described.at("current"), action_size);
        if (input_ == "forecast") {
            if (current_.empty()) current_ = head_;  // at age 0 the observation is the forecast
            forecast_ = network(weights, "forecast", augmented, described.at("forecast"), obs_size);
            for (std::size_t i = 0; i + 1 < forecast_.size(); ++i)
                norms_.push_back(norm(weights, "forecast." + std::to_string(i) + ".norm", forecast_[i].outputs));
        }
        if (input_ == "transformer" && (current_.empty() || width == 0))
            refuse("a transformer needs a width, and a network for age 0");
        if (input_ == "transformer") encoder(weights, width, blocks);
    }

    std::size_t obs_size, action_size, max_age;

    // obs [S]; actions [Δ, A], oldest first, in the task's units; age 0..Δ -> action [A]
    Floats act(const Floats& obs, const Floats& actions, std::size_t age) const {
        if (age > max_age)
            refuse("the policy takes ages 0.." + std::to_string(max_age) + "; got " + std::to_string(age));
        if (obs.size() != obs_size || actions.size() != max_age * action_size)
            refuse("the policy takes " + std::to_string(obs_size) + " numbers of an observation and " +
                   std::to_string(max_age * action_size) + " of the action history; got " +
                   std::to_string(obs.size()) + " and " + std::to_string(actions.size()));
        for (float value : obs)
            if (!std::isfinite(value)) refuse("the observation holds a number that is not finite");
        Floats scaled(age * action_size);
        for (std::size_t i = 0; i < scaled.size(); ++i) {
            if (!std::isfinite(actions[i])) refuse("the action history holds a number that is not finite");
            const std::size_t j = i % action_size;
            scaled[i] = (actions[i] - low_[j]) * (2 / (high_[j] - low_[j])) - 1;
        }
        Floats action;
        if (age == 0 && !current_.empty()) {
            action = mlp(current_, obs);
        } else if (input_ == "transformer") {
            action = mlp(head_, encode(obs, scaled, age));
        } else {
            Floats x = obs;
            if (input_ != "observation") {
                x.insert(x.end(), scaled.begin(), scaled.end());
                x.resize(obs_size + max_age * action_size);
                x.push_back(static_cast<float>(age) / static_cast<float>(max_age));
            }
            if (input_ == "forecast") {
                x = mlp(forecast_, x, norms_);
                for (std::size_t j = 0; j < obs_size; ++j) x[j] += obs[j];
            }
            action = mlp(head_, x);
        }
        for (std::size_t j = 0; j < action_size; ++j) {
            action[j] = low_[j] + (std::tanh(action[j]) + 1) * ((high_[j] - low_[j]) / 2);
            action[j] = std::min(action[j], high_[j]);  // rounding may have brought it beyond
            if (!std::isfinite(action[j])) refuse("numbers so large that the action is not finite");
        }
        return action;
    }

   private:
    std::string input_;
    Floats low_, high_, position_;
    Mlp head_, current_, forecast_;
    std::vector<Norm> norms_;  // of the forecast
    Layer of_obs_, of_action_, join_obs_, join_action_;
    Norm norm_in_, norm_out_;
    std::vector<Block> blocks_;

    static Floats numbers(const Json& list) {
        Floats values;
        for (const Json& item : list.items) {
            if (item.kind != Json::number) refuse("low and high must be numbers");
            values.push_back(static_cast<float>(item.value));
        }
        return values;
    }

    static Layer layer(const Weights& weights, const std::string& name, std::size_t inputs, std::size_t outputs) {
        return {inputs, outputs, weights.take(name + ".w", {inputs, outputs}), weights.take(name + ".b", {outputs})};
    }

    static Norm norm(const Weights& weights, const std::string& name, std::size_t width) {
        return {weights.take(name + ".scale", {width}), weights.take(name + ".shift", {width})};
    }

    static Mlp network(const Weights& weights, const std::string& name, std::size_t inputs, const Json& hidden,
                       std::size_t outputs) {
        std::vector<std::size_t> sizes = hidden.integers(1e6);
        sizes.push_back(outputs);
        Mlp layers;
        for (std::size_t i = 0; i < sizes.size(); ++i) {
            layers.push_back(layer(weights, name + "." + std::to_string(i), inputs, sizes[i]));
            inputs = sizes[i];
        }
        return layers;
    }

    void encoder(const Weights& weights, std::size_t width, std::size_t blocks) {
        of_obs_ = layer(weights, "encoder.obs", obs_size, width);
        of_action_ = layer(weights, "encoder.action", action_size, width);
        const Layer join = layer(weights, "encoder.join", 2 * width, width);  // applied to both embeddings side by side
        const auto middle = join.w.begin() + width * width;
        join_obs_ = {width, width, Floats(join.w.begin(), middle), join.b};
        join_action_ = {width, width, Floats(middle, join.w.end()), Floats(width)};
        position_ = weights.take("encoder.position", {max_age, width});
        norm_in_ = norm(weights, "encoder.norm_in", width);
        norm_out_ = norm(weights, "encoder.norm_out", width);
        for (std::size_t i = 0; i < blocks; ++i) {
            const std::string name = "encoder.blocks." + std::to_string(i);
            const Layer qkv = layer(weights, name + ".qkv", width, 3 * width);
            const Layer out = layer(weights, name + ".out", width, width);
            Layer attend{width, width, Floats(width * width), Floats(width)}, value = attend;
            // row r of q, k or v; row `width` holds the biases
            auto part = [&](std::size_t r, std::size_t which) {
                return (r < width ? &qkv.w[r * 3 * width] : &qkv.b[0]) + which * width;
            };
            for (std::size_t r = 0; r <= width; ++r)
                for (std::size_t j = 0; j < width; ++j) {
                    double asked = 0, given = r < width ? 0 : out.b[j];
                    for (std::size_t k = 0; k < width; ++k) {
                        asked += double(part(r, 0)[k]) * part(j, 1)[k];
                        given += double(part(r, 2)[k]) * out.w[k * width + j];
                    }
                    (r < width ? attend.w[r * width + j] : attend.b[j]) = static_cast<float>(asked / std::sqrt(double(width)));
                    (r < width ? value.w[r * width + j] : value.b[j]) = static_cast<float>(given);
                }
            blocks_.push_back({norm(weights, name + ".norm1", width), norm(weights, name + ".norm2", width), attend, value,
                               layer(weights, name + ".mlp.0", width, width), layer(weights, name + ".mlp.1", width, width)});
        }
    }

    // The transformer's output at position age - 1, which alone is read: [width]
    Floats encode(const Floats& obs, const Floats& actions, std::size_t age) const {
        const std::size_t width = norm_in_.scale.size();
        const Floats from_obs = linear(join_obs_, linear(of_obs_, obs, 1), 1);
        Floats x = linear(join_action_, linear(of_action_, actions, age), age);
        for (std::size_t i = 0; i < x.size(); ++i) x[i] += position_[i] + from_obs[i % width];
        x = norm_in_(std::move(x));
        for (std::size_t i = 0; i < blocks_.size(); ++i) {
            const Block& block = blocks_[i];
            x = block.norm1(std::move(x));
            const bool last = i + 1 == blocks_.size();
            const std::size_t first = last ? age - 1 : 0, rows = age - first;  // the positions that are needed
            Floats asking(x.begin() + first * width, x.end());
            const Floats asked = linear(block.attend, asking, rows);
            Floats mixed(rows * width);
            for (std::size_t r = 0; r < rows; ++r) {
                Floats share(first + r + 1);  // causal: position t attends to 0..t
                for (std::size_t s = 0; s < share.size(); ++s) {
                    double score = 0;
                    for (std::size_t j = 0; j < width; ++j) score += asked[r * width + j] * x[s * width + j];
                    share[s] = static_cast<float>(score);
                }
                const float most = *std::max_element(share.begin(), share.end());
                float sum = 0;
                for (float& value : share) sum += value = std::exp(value - most);
                for (std::size_t s = 0; s < share.size(); ++s)
                    for (std::size_t j = 0; j < width; ++j) mixed[r * width + j] += share[s] / sum * x[s * width + j];
            }
            const Floats given = linear(block.value, mixed, rows);
            for (std::size_t j = 0; j < asking.size(); ++j) asking[j] += given[j];
            Floats hidden = linear(block.first, block.norm2(asking), rows);
            for (float& value : hidden) value = 0.5f * value * (1 + std::erf(value * 0.70710678f));
            const Floats change = linear(block.second, hidden, rows);
            for (std::size_t j = 0; j < asking.size(); ++j) asking[j] += change[j];
            x = std::move(asking);
        }
        return norm_out_(Floats(x.end() - width, x.end()));
    }
};

// ---- The program -------------------------------------------------------------------------------------------------

void serve(const Policy& policy) {
    std::string line;
    while (std::getline(std::cin, line)) {
        std::istringstream words(line);
        double age = -1;
        Floats obs(policy.obs_size), actions(policy.max_age * policy.action_size);
        words >> age;
        for (float& value : obs) words >> value;
        for (float& value : actions) words >> value;
        std::string rest;
        if (!words || !(age >= 0 && age < 1e9) || age != std::floor(age) || words >> rest)
            refuse("a line needs an age, " + std::to_string(obs.size()) + " numbers of an observation and " +
                   std::to_string(actions.size()) + " of the action history, nothing else");
        const Floats action = policy.act(obs, actions, static_cast<std::size_t>(age));
        for (std::size_t j = 0; j < action.size(); ++j) std::printf(j ? " %.9g" : "%.9g", action[j]);
        std::printf("\n");
        std::fflush(stdout);
    }
}

void time_decisions(const Policy& policy, int decisions, std::size_t age) {
    std::mt19937 random(0);
    std::normal_distribution<float> normal;
    std::uniform_real_distribution<float> uniform(-1, 1);
    std::vector<double> taken, worked;
    for (int i = -50; i < decisions; ++i) {
        Floats obs(policy.obs_size), actions(policy.max_age * policy.action_size);
        for (float& value : obs) value = normal(random);
        for (float& value : actions) value = uniform(random);
        const std::clock_t clock = std::clock();
        const auto began = std::chrono::steady_clock::now();
        policy.act(obs, actions, age);
        const std::chrono::duration<double, std::milli> passed = std::chrono::steady_clock::now() - began;
        const double work = 1000.0 * static_cast<double>(std::clock() - clock) / CLOCKS_PER_SEC;
        if (i < 0) continue;  // warm-up
        taken.push_back(passed.count());
        worked.push_back(work);
    }
    auto quantile = [](std::vector<double>& values, double share) {
        std::sort(values.begin(), values.end());
        return values[static_cast<std::size_t>(share * static_cast<double>(values.size() - 1))];
    };
    std::printf("%.4f %.4f %.4f ", quantile(taken, 0.5), quantile(taken, 0.99), quantile(taken, 1));
    std::printf("%.4f\n", quantile(worked, 0.99));
}

int main(int count, char** words) {
    try {
        if (count == 2) {
            serve(Policy(words[1]));
        } else if (count == 5 && std::string(words[2]) == "--latency" && std::atoi(words[3]) > 0) {
            time_decisions(Policy(words[1]), std::atoi(words[3]), static_cast<std::size_t>(std::atoi(words[4])));
        } else {
            refuse("usage: controller BUNDLE [--latency N AGE]");
        }
    } catch (const std::exception& error) {
        std::cerr << "controller: " << error.what() << "\n";
        return 2;
    }
}
