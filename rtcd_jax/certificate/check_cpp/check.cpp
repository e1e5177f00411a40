// A second checker of certificates, in another language: it decides the files that docs/certificates.md describes, by
// exact arithmetic, and shares no line with the one in `check/`. Two programs that were written apart are seldom wrong
// in the same place: where both accept a file, a mistake in either of them, in Python, in python-flint or in GMP alone
// makes no false statement.
//
//     g++ -O1 -std=c++17 check.cpp -lgmpxx -lgmp -o check && ./check FILE [--seconds N]    or    ./check --cycle FILE FILE
//
// Exit code 0 if all of a file holds, 1 if it is refused, 2 if it is undecided or there is nothing to read.
//
// THEOREM (proved in check/__init__.py). Robots: M(q) v' = motor (u + w) - damping v - dU/dq - c(q, v), numbers in a
// box; D = det M, D x' = a + b (u + w). Where |y| = 1 on x = x*(t) + L(t) y,
//
//     q = -c y' adj(L) (a + b (u + w) - D (x*' + L' y)) = -d/dt |y|^2 times a positive function, c > 0,
//
// and nothing leaves the funnel if q > 0 for every input u + w that can act. The file proves it by sums of squares.
//
// Sections: verdicts, SHA-256, JSON, polynomials, enclosures, robots, positivity, sums of squares, the claim, inputs,
// old measurements, the funnel, the goal, the catch, the file's parts, the verdict, the sentence, the command.

#include <algorithm>
#include <cmath>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <cerrno>
#include <functional>
#include <initializer_list>
#include <map>
#include <memory>
#include <new>
#include <optional>
#include <set>
#include <string>
#include <tuple>
#include <unordered_map>
#include <utility>
#include <vector>

#include <fcntl.h>
#include <sys/time.h>
#include <unistd.h>

#include <gmpxx.h>

using Z = mpz_class;
using Q = mpq_class;
using std::string;
using std::vector;
using Row = vector<Q>;
using Matrix = vector<Row>;

// Verdicts ------------------------------------------------------------------------------------------------------------

constexpr int BITS = 128;             // of the fixed point in which enclosures count; every rounding is added to a bound
constexpr long MAX_BYTES = 1L << 28;  // of a file
constexpr int MAX_ORDER = 16, MAX_TERMS = 10000, MAX_NOTES = 20, LONGEST_NAME = 40, LONGEST_NOTE = 79;
constexpr int MOST_JOINTS = 4, MOST_TERMS_OF_ROBOT = 200, HIGHEST = 8, MOST_UNCERTAIN = 6, MOST_GRAMS = 32, MOST_HALVINGS = 4;
constexpr size_t MOST_FURTHER = 32, MOST_SHIFTS = 20;
constexpr int HIGHEST_SHIFT = 3;
constexpr int MAX_DEPTH = 100;                   // of lists and objects; a certificate has a dozen
constexpr double MOST_COEFFICIENTS = 4e6;        // of a polynomial in Bernstein form: some 200 MB
constexpr long MOST_TURNS = 1000000;             // largest angle [rad] of a goal
constexpr int DEPTH = 10, DEPTH_OF_CASES = 4;    // halvings on the way to a polynomial's sign

struct Refused {
  string place, reason;
};
struct Undecided {
  string reason;
};

void require(bool holds, const string& place, const string& reason) {
  if (!holds) throw Refused{place, reason};
}

vector<uint32_t> code_points(const string& text) {
  vector<uint32_t> points;
  for (size_t i = 0; i < text.size();) {
    unsigned char c = text[i++];
    int more = c < 0x80 ? 0 : c < 0xe0 ? 1 : c < 0xf0 ? 2 : 3;
    uint32_t point = more == 0 ? c : c & (0x3f >> more);
    for (; more > 0 && i < text.size(); more--) point = point << 6 | (text[i++] & 0x3f);
    points.push_back(point);
  }
  return points;
}

// A file's text on one line of ASCII, without control sequences.
string printable(const string& text, size_t longest = 400) {
  string shown;
  auto points = code_points(text);
  char piece[16];
  for (size_t i = 0; i < points.size() && i < longest; i++) {
    uint32_t c = points[i];
    if (c == '\\') shown += "\\\\";
    else if (c == '\n') shown += "\\n";
    else if (c == '\r') shown += "\\r";
    else if (c == '\t') shown += "\\t";
    else if (c >= ' ' && c <= '~') shown += char(c);
    else {
      std::snprintf(piece, sizeof piece, c < 0x100 ? "\\x%02x" : c < 0x10000 ? "\\u%04x" : "\\U%08x", c);
      shown += piece;
    }
  }
  if (shown.size() <= longest && points.size() <= longest) return shown;
  return shown.substr(0, longest - 3) + "...";
}

string formatted(const char* format, double value) {
  char text[64];
  std::snprintf(text, sizeof text, format, value);
  return text;
}

double rounded(const Q& q) {  // infinite where no double holds it
  double value = q.get_d();
  if (abs(q) > Q(1.7976931348623157e308)) return q > 0 ? HUGE_VAL : -HUGE_VAL;
  return value;
}

// SHA-256 (FIPS 180-4) -------------------------------------------------------------------------------------------------

string sha256(const string& text) {
  static const uint32_t k[64] = {
      0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
      0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
      0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
      0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
      0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
      0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
      0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
      0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};
  uint32_t h[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
  auto turn = [](uint32_t x, int by) { return x >> by | x << (32 - by); };
  auto block = [&](const unsigned char* p) {
    uint32_t w[64];
    for (int i = 0; i < 16; i++)
      w[i] = uint32_t(p[4 * i]) << 24 | uint32_t(p[4 * i + 1]) << 16 | uint32_t(p[4 * i + 2]) << 8 | p[4 * i + 3];
    for (int i = 16; i < 64; i++) {
      uint32_t a = w[i - 15], b = w[i - 2];
      w[i] = w[i - 16] + (turn(a, 7) ^ turn(a, 18) ^ a >> 3) + w[i - 7] + (turn(b, 17) ^ turn(b, 19) ^ b >> 10);
    }
    uint32_t v[8];
    std::copy(h, h + 8, v);
    for (int i = 0; i < 64; i++) {
      uint32_t one = v[7] + (turn(v[4], 6) ^ turn(v[4], 11) ^ turn(v[4], 25)) + ((v[4] & v[5]) ^ (~v[4] & v[6])) + k[i] + w[i];
      uint32_t two = (turn(v[0], 2) ^ turn(v[0], 13) ^ turn(v[0], 22)) + ((v[0] & v[1]) ^ (v[0] & v[2]) ^ (v[1] & v[2]));
      for (int j = 7; j > 0; j--) v[j] = v[j - 1];
      v[4] += one;
      v[0] = one + two;
    }
    for (int i = 0; i < 8; i++) h[i] += v[i];
  };
  auto bytes = reinterpret_cast<const unsigned char*>(text.data());
  size_t whole = text.size() / 64 * 64;
  for (size_t i = 0; i < whole; i += 64) block(bytes + i);
  unsigned char last[128] = {0};
  size_t left = text.size() - whole, length = left < 56 ? 64 : 128;
  std::copy(bytes + whole, bytes + text.size(), last);
  last[left] = 0x80;
  for (int i = 0; i < 8; i++) last[length - 1 - i] = (unsigned char)(uint64_t(text.size()) * 8 >> (8 * i));
  for (size_t i = 0; i < length; i += 64) block(last + i);
  string hex;
  char piece[9];
  for (uint32_t word : h) {
    std::snprintf(piece, sizeof piece, "%08x", word);
    hex += piece;
  }
  return hex;
}

// JSON -----------------------------------------------------------------------------------------------------------------

struct Value {
  enum Kind { NUL, TRUTH, INTEGER, REAL, TEXT, LIST, OBJECT } kind = NUL;
  string text;          // UTF-8 of a text, surrogates that stand alone too; the characters of anything else
  vector<Value> parts;  // of a list; the values of an object
  vector<string> keys;  // of an object, in the file's order

  const Value* find(const string& key) const {
    for (size_t i = 0; i < keys.size(); i++)
      if (keys[i] == key) return &parts[i];
    return nullptr;
  }
};

class Reader {
 public:
  explicit Reader(const string& bytes) : text(bytes) {}

  Value whole() {
    for (unsigned char c : text) require(c < 0x80, "certificate", "is no ASCII text");
    Value value = any(0);
    space();
    must(at == text.size());
    return value;
  }

 private:
  const string& text;
  size_t at = 0;

  void must(bool holds) const { require(holds, "certificate", "is no JSON: at character " + std::to_string(at)); }
  char peek() const { return at < text.size() ? text[at] : '\0'; }
  void space() {
    while (at < text.size() && std::strchr(" \t\n\r", text[at]) && text[at]) at++;
  }
  bool next(const char* word) {
    size_t n = std::strlen(word);
    if (text.compare(at, n, word) != 0) return false;
    at += n;
    return true;
  }

  Value any(int depth) {
    require(depth < MAX_DEPTH, "certificate", "is nested too deeply");
    space();
    Value value;
    if (next("null")) value.text = "null";
    else if (next("true") || next("false")) value.kind = Value::TRUTH, value.text = text[at - 2] == 'u' ? "true" : "false";
    else if (peek() == '"') value.kind = Value::TEXT, value.text = quoted();
    else if (next("[")) list(value, depth);
    else if (next("{")) object(value, depth);
    else number(value);
    return value;
  }

  void list(Value& value, int depth) {
    value.kind = Value::LIST;
    space();
    if (next("]")) return;
    do {
      value.parts.push_back(any(depth + 1));
      space();
    } while (next(","));
    must(next("]"));
    value.parts.shrink_to_fit();
  }

  void object(Value& value, int depth) {
    value.kind = Value::OBJECT;
    space();
    if (next("}")) return;
    do {
      space();
      must(peek() == '"');
      value.keys.push_back(quoted());
      space();
      must(next(":"));
      value.parts.push_back(any(depth + 1));
      space();
    } while (next(","));
    must(next("}"));
    std::set<string> different(value.keys.begin(), value.keys.end());
    require(different.size() == value.keys.size(), "certificate", "has the same key twice");
  }

  void number(Value& value) {
    for (const char* word : {"NaN", "Infinity", "-Infinity"})
      require(text.compare(at, std::strlen(word), word) != 0, "certificate", string("holds ") + word);
    size_t from = at;
    auto digits = [&] {
      size_t before = at;
      while (peek() >= '0' && peek() <= '9') at++;
      return at - before;
    };
    next("-");
    size_t leading = at, count = digits();
    must(count > 0 && (count == 1 || text[leading] != '0') && count <= 4300);
    value.kind = Value::INTEGER;
    if (peek() == '.') {
      at++;
      must(digits() > 0);
      value.kind = Value::REAL;
    }
    if (peek() == 'e' || peek() == 'E') {
      at++;
      if (peek() == '+' || peek() == '-') at++;
      must(digits() > 0);
      value.kind = Value::REAL;
    }
    value.text = text.substr(from, at - from);
    if (value.text == "-0") value.text = "0";
  }

  uint32_t four() {
    uint32_t unit = 0;
    for (int i = 0; i < 4; i++, at++) {
      char c = peek();
      must((c >= '0' && c <= '9') || (c >= 'a' && c <= 'f') || (c >= 'A' && c <= 'F'));
      unit = unit << 4 | uint32_t(c <= '9' ? c - '0' : (c | 32) - 'a' + 10);
    }
    return unit;
  }

  string quoted() {
    must(next("\""));
    string out;
    while (peek() != '"') {
      must(at < text.size() && (unsigned char)text[at] >= 0x20);
      if (text[at] != '\\') {
        out += text[at++];
        continue;
      }
      at++;
      char kind = peek();
      at++;
      if (kind == 'u') {
        uint32_t point = four();
        if (point >= 0xd800 && point < 0xdc00 && text.compare(at, 2, "\\u") == 0) {
          size_t before = at;
          at += 2;
          uint32_t low = four();
          if (low >= 0xdc00 && low < 0xe000) point = 0x10000 + ((point - 0xd800) << 10 | (low - 0xdc00));
          else at = before;
        }
        append(out, point);
        continue;
      }
      const char *from = "\"\\/bfnrt", *to = "\"\\/\b\f\n\r\t", *found = kind ? std::strchr(from, kind) : nullptr;
      must(found != nullptr);
      out += to[found - from];
    }
    at++;
    return out;
  }

  static void append(string& out, uint32_t c) {
    if (c < 0x80) out += char(c);
    else if (c < 0x800) out += {char(0xc0 | c >> 6), char(0x80 | (c & 0x3f))};
    else if (c < 0x10000) out += {char(0xe0 | c >> 12), char(0x80 | (c >> 6 & 0x3f)), char(0x80 | (c & 0x3f))};
    else out += {char(0xf0 | c >> 18), char(0x80 | (c >> 12 & 0x3f)), char(0x80 | (c >> 6 & 0x3f)), char(0x80 | (c & 0x3f))};
  }
};

void write_text(const string& text, string& out) {
  char piece[16];
  out += '"';
  for (uint32_t c : code_points(text)) {
    const char *from = "\"\\\b\f\n\r\t", *to = "\"\\bfnrt", *found = c && c < 0x80 ? std::strchr(from, int(c)) : nullptr;
    if (found) out += '\\', out += to[found - from];
    else if (c >= ' ' && c <= '~') out += char(c);
    else if (c < 0x10000) std::snprintf(piece, sizeof piece, "\\u%04x", c), out += piece;
    else {
      std::snprintf(piece, sizeof piece, "\\u%04x\\u%04x", 0xd800 + ((c - 0x10000) >> 10), 0xdc00 + ((c - 0x10000) & 0x3ff));
      out += piece;
    }
  }
  out += '"';
}

// Sorted keys, no spaces, ASCII.
void write_canonical(const Value& value, string& out) {
  if (value.kind == Value::TEXT) {
    write_text(value.text, out);
  } else if (value.kind == Value::LIST) {
    out += '[';
    for (size_t i = 0; i < value.parts.size(); i++) {
      if (i) out += ',';
      write_canonical(value.parts[i], out);
    }
    out += ']';
  } else if (value.kind == Value::OBJECT) {
    vector<size_t> order(value.keys.size());
    for (size_t i = 0; i < order.size(); i++) order[i] = i;
    std::sort(order.begin(), order.end(), [&](size_t a, size_t b) { return value.keys[a] < value.keys[b]; });
    out += '{';
    for (size_t i = 0; i < order.size(); i++) {
      if (i) out += ',';
      write_text(value.keys[order[i]], out);
      out += ':';
      write_canonical(value.parts[order[i]], out);
    }
    out += '}';
  } else {
    out += value.text;
  }
}

string digest(const Value& value) {
  string text;
  write_canonical(value, text);
  return sha256(text);
}

string joined(const vector<string>& words) {
  string text;
  for (auto& word : words) text += (text.empty() ? "" : ", ") + word;
  return text;
}

// A value of the file and where it stands.
struct Node {
  string place;
  const Value* value;

  void require(bool holds, const string& reason) const { ::require(holds, place, reason); }
  bool is(Value::Kind kind) const { return value->kind == kind; }
  bool has(const string& key) const { return is(Value::OBJECT) && value->find(key); }
  Node at(const string& key) const { return {place + "." + key, value->find(key)}; }

  // The object must have these keys and the digests of their values.
  void keys(vector<string> names) const {
    require(is(Value::OBJECT), "must be an object");
    vector<string> wrong, expected = names;
    expected.push_back("sha256");
    for (auto& name : expected)
      if (!value->find(name)) wrong.push_back(name);
    for (auto& key : value->keys)
      if (std::find(expected.begin(), expected.end(), key) == expected.end()) wrong.push_back(key);
    std::sort(wrong.begin(), wrong.end());
    require(wrong.empty(), "has unknown keys or lacks some: " + joined(wrong));
    Node digests = at("sha256");
    bool holds = digests.is(Value::OBJECT) && digests.value->keys.size() == names.size();
    for (auto& name : names) holds = holds && digests.value->find(name);
    digests.require(holds, "must be digests of " + joined(names));
  }

  void exactly(const vector<string>& names) const {
    bool holds = is(Value::OBJECT) && value->keys.size() == names.size();
    for (auto& name : names) holds = holds && value->find(name);
    require(holds, "must have the keys " + joined(names));
  }

  void digests() const {
    const Value* stored = value->find("sha256");
    for (size_t i = 0; i < stored->keys.size(); i++) {
      const Value& one = stored->parts[i];
      bool same = one.kind == Value::TEXT && one.text == digest(*value->find(stored->keys[i]));
      ::require(same, place + "." + stored->keys[i], "was changed: its digest is another");
    }
  }

  vector<Node> items(long count = -1, long least = 0) const {
    require(is(Value::LIST), "must be a list");
    long entries = long(value->parts.size());
    string has = "has " + std::to_string(entries) + " entries, must have ";
    require(count < 0 || entries == count, has + std::to_string(count));
    require(entries >= least, has + "at least " + std::to_string(least));
    vector<Node> nodes;
    nodes.reserve(size_t(entries));
    for (long i = 0; i < entries; i++) nodes.push_back({place + "[" + std::to_string(i) + "]", &value->parts[size_t(i)]});
    return nodes;
  }

  Q number() const {
    require(is(Value::TEXT) && is_double(value->text), "must be a double in hexadecimal");
    double x = std::strtod(value->text.c_str(), nullptr);
    require(std::isfinite(x), "is too large for a double");
    return Q(x);
  }

  Q at_least_zero() const {
    Q x = number();
    require(x >= 0, "must be >= 0");
    return x;
  }

  long integer(long low, long high) const {
    bool holds = is(Value::INTEGER) && value->text.size() < 18;
    long x = holds ? std::strtol(value->text.c_str(), nullptr, 10) : 0;
    require(holds && low <= x && x <= high, "must be an integer from " + std::to_string(low) + " to " + std::to_string(high));
    return x;
  }

  Row row(long n) const {
    Row numbers;
    for (auto& node : items(n)) numbers.push_back(node.number());
    return numbers;
  }

  Matrix matrix(long rows, long columns) const {
    Matrix numbers;
    for (auto& node : items(rows)) numbers.push_back(node.row(columns));
    return numbers;
  }

  // Of which the file has the upper triangle row by row.
  Matrix symmetric(size_t rows) const {
    auto entries = items(long(rows * (rows + 1) / 2));
    Matrix full(rows, Row(rows));
    size_t at = 0;
    for (size_t i = 0; i < rows; i++)
      for (size_t j = i; j < rows; j++) full[i][j] = full[j][i] = entries[at++].number();
    return full;
  }

  string name() const {
    require(is(Value::TEXT) && code_points(value->text).size() <= LONGEST_NAME, "must be a short text");
    return value->text;
  }

  vector<string> names(long count = -1, long least = 0) const {
    vector<string> texts;
    for (auto& node : items(count, least)) texts.push_back(node.name());
    return texts;
  }

  vector<std::pair<string, Node>> named() const {
    require(is(Value::OBJECT), "must be an object");
    vector<std::pair<string, Node>> entries;
    for (auto& key : value->keys) {
      require(code_points(key).size() <= LONGEST_NAME, "must be a short text");
      entries.push_back({key, at(key)});
    }
    return entries;
  }

  std::pair<Q, Q> range() const {
    Row ends = row(2);
    require(ends[0] <= ends[1], "must rise");
    return {ends[0], ends[1]};
  }

 private:
  static bool is_double(const string& text) {  // -?0x[01](.h{1,13})?p[+-]d{1,4}
    size_t i = text.size() > 0 && text[0] == '-';
    if (text.compare(i, 2, "0x") != 0) return false;
    i += 2;
    if (i >= text.size() || (text[i] != '0' && text[i] != '1')) return false;
    i++;
    auto run = [&](const char* digits, size_t most) {
      size_t from = i;
      while (i < text.size() && text[i] && std::strchr(digits, text[i])) i++;
      return i - from >= 1 && i - from <= most;
    };
    if (i < text.size() && text[i] == '.') {
      i++;
      if (!run("0123456789abcdef", 13)) return false;
    }
    if (i + 1 >= text.size() || text[i] != 'p' || (text[i + 1] != '+' && text[i + 1] != '-')) return false;
    i += 2;
    return run("0123456789", 4) && i == text.size();
  }
};

// Exact polynomials in the time of an interval -------------------------------------------------------------------------

using Curve = vector<Q>;  // coefficients of 1, s, s^2, ..

Curve operator+(const Curve& a, const Curve& b) {
  Curve sum = a.size() > b.size() ? a : b;
  const Curve& less = a.size() > b.size() ? b : a;
  for (size_t i = 0; i < less.size(); i++) sum[i] += less[i];
  return sum;
}
Curve operator*(const Curve& a, const Q& q) {
  Curve out = a;
  for (auto& c : out) c *= q;
  return out;
}
Curve operator-(const Curve& a, const Curve& b) { return a + b * Q(-1); }
Curve operator*(const Curve& a, const Curve& b) {
  if (a.empty() || b.empty()) return {};
  Curve out(a.size() + b.size() - 1);
  for (size_t i = 0; i < a.size(); i++)
    for (size_t j = 0; j < b.size(); j++) out[i + j] += a[i] * b[j];
  return out;
}
Curve slope(const Curve& a) {
  Curve out;
  for (size_t i = 1; i < a.size(); i++) out.push_back(a[i] * Q(long(i)));
  return out;
}
Curve at(const Curve& outer, const Curve& inner) {
  Curve total;
  for (size_t i = outer.size(); i-- > 0;) total = total * inner + Curve{outer[i]};
  return total;
}

template <class T, class U>
auto dot(const vector<T>& a, const vector<U>& b) {
  auto total = a[0] * b[0];
  for (size_t i = 1; i < a.size(); i++) total = total + a[i] * b[i];
  return total;
}
template <>
auto dot(const Row& a, const Row& b) {
  Q total = 0;
  for (size_t i = 0; i < a.size(); i++) total += a[i] * b[i];
  return total;
}

template <class T>
vector<vector<T>> transposed(const vector<vector<T>>& m) {
  vector<vector<T>> out(m[0].size());
  for (auto& row : m)
    for (size_t j = 0; j < row.size(); j++) out[j].push_back(row[j]);
  return out;
}

// Adjugate and determinant by Laplace; `one` is the 1 of the entries.
template <class T>
std::pair<vector<vector<T>>, T> cofactors(const vector<vector<T>>& m, const T& one) {
  size_t n = m.size();
  std::function<T(const vector<size_t>&, const vector<size_t>&)> det = [&](auto& rows, auto& columns) -> T {
    if (rows.empty()) return one;
    if (rows.size() == 1) return m[rows[0]][columns[0]];
    vector<size_t> below(rows.begin() + 1, rows.end());
    std::optional<T> total;
    for (size_t k = 0; k < columns.size(); k++) {
      vector<size_t> others = columns;
      others.erase(others.begin() + long(k));
      T part = m[rows[0]][columns[k]] * Q(k % 2 ? -1 : 1) * det(below, others);
      total = total ? *total + part : part;
    }
    return *total;
  };
  vector<size_t> all(n);
  for (size_t i = 0; i < n; i++) all[i] = i;
  vector<vector<T>> adjugate(n, vector<T>(n, one));
  for (size_t i = 0; i < n; i++)
    for (size_t j = 0; j < n; j++) {
      vector<size_t> rows = all, columns = all;
      rows.erase(rows.begin() + long(j));
      columns.erase(columns.begin() + long(i));
      adjugate[i][j] = det(rows, columns) * Q((i + j) % 2 ? -1 : 1);
    }
  return {adjugate, det(all, all)};
}

// Enclosures -----------------------------------------------------------------------------------------------------------
//
// A Model is a polynomial p in (s, y_1 .. y_n, p_1 .. p_m), in fixed point of 2^-BITS, and two bounds in the same unit:
// the function is within d + r |s| of p wherever |s|, |y|, |p_i| <= 1. At the goal s is the level l, so that r counts
// what vanishes with it. Terms of higher order in s or y than the space's go to the bounds; powers of p stay, or count
// as `stride` powers of y each.

using Key = unsigned __int128;  // exponents, one byte a variable: s first

struct KeyHash {
  size_t operator()(Key k) const {
    uint64_t x = uint64_t(k) * 0x9e3779b97f4a7c15u ^ uint64_t(k >> 64) * 0xc2b2ae3d27d4eb4fu;
    return size_t(x ^ x >> 29);
  }
};
inline int exponent(Key k, int variable) { return int(k >> (8 * variable)) & 255; }
inline Key power(int variable, int e = 1) { return Key(e) << (8 * variable); }

struct Space {
  int n, m, s_order, y_order, stride = 0;

  int others() const { return n + m; }
  Key y_part(Key k) const { return k >> 8 & ((Key(1) << (8 * n)) - 1); }
  int y_degree(Key k) const {
    int total = 0;
    for (int i = 1; i <= n; i++) total += exponent(k, i);
    return total;
  }
  bool has(Key k) const {  // whether it is within the orders
    int total = y_degree(k);
    if (stride)
      for (int i = n + 1; i <= n + m; i++) total += stride * exponent(k, i);
    return exponent(k, 0) <= s_order && total <= y_order;
  }
  Key robot(const vector<int>& powers) const {
    Key key = 0;
    for (size_t i = 0; i < powers.size(); i++) key += power(1 + n + int(i), powers[i]);
    return key;
  }
};

const Z UNIT = Z(1) << BITS;

Z shifted_up(const Z& x) {  // x 2^-BITS, rounded up
  Z out;
  mpz_cdiv_q_2exp(out.get_mpz_t(), x.get_mpz_t(), BITS);
  return out;
}
Z nearest(const Q& q, bool& exact, int bits = BITS) {
  Z scaled = q.get_num() << bits, out;
  exact = mpz_divisible_p(scaled.get_mpz_t(), q.get_den_mpz_t()) != 0;
  Z twice = 2 * scaled + q.get_den(), double_den = 2 * q.get_den();
  mpz_fdiv_q(out.get_mpz_t(), twice.get_mpz_t(), double_den.get_mpz_t());
  return out;
}
Z up(const Q& q) {
  Z scaled = q.get_num() << BITS, out;
  mpz_cdiv_q(out.get_mpz_t(), scaled.get_mpz_t(), q.get_den_mpz_t());
  return out;
}
Q exactly(const Z& fixed) {
  Q q(fixed, UNIT);
  q.canonicalize();
  return q;
}
Z root_up(const Q& q) {  // of q >= 0, in fixed point
  Z square = q.get_num() << (2 * BITS), root;
  mpz_cdiv_q(square.get_mpz_t(), square.get_mpz_t(), q.get_den_mpz_t());
  mpz_sqrt(root.get_mpz_t(), square.get_mpz_t());
  return root * root == square ? root : Z(root + 1);
}

// An upper bound of |y^e| on the unit ball, in fixed point: the product of (e_i / e)^(e_i / 2), by Lagrange.
const Z& peak(Key y_exponents) {
  static std::unordered_map<Key, Z, KeyHash> known;
  auto found = known.find(y_exponents);
  if (found != known.end()) return found->second;
  unsigned total = 0, variables = 0;
  for (Key k = y_exponents; k; k >>= 8) total += unsigned(k & 255), variables += (k & 255) != 0;
  Z bound = UNIT;
  if (variables > 1) {
    Q square = 1;
    for (Key k = y_exponents; k; k >>= 8)
      for (unsigned i = 0; i < unsigned(k & 255); i++) square *= Q(unsigned(k & 255), total);
    bound = root_up(square);
  }
  return known.emplace(y_exponents, bound).first->second;
}

struct Term {
  Key key;
  Z c;
};

struct Model {
  const Space* space;
  vector<Term> p;  // sorted by key, none of them zero
  Z r, d;

  explicit Model(const Space& s) : space(&s) {}

  void count(Key key, const Z& error) { (exponent(key, 0) ? r : d) += error; }

  Z size() const {
    Z sum = 0, total = 0;
    for (auto& t : p) sum = abs(t.c) * peak(space->y_part(t.key)), total += sum;
    return shifted_up(total);
  }
  Q largest() const { return exactly(size() + r + d); }
  Z constant() const { return !p.empty() && p[0].key == 0 ? p[0].c : Z(0); }
  Q least() const { return exactly(2 * constant() - size() - r - d); }

  // The same function within the orders of its space.
  Model tidy() const {
    Model out(*space);
    out.r = r, out.d = d;
    for (auto& t : p) {
      if (!space->has(t.key))
        out.count(t.key, shifted_up(abs(t.c) * peak(space->y_part(t.key))));
      else
        out.p.push_back(t);
    }
    return out;
  }

  Model in(const Space& other) const {
    Model out = *this;
    out.space = &other;
    return out;
  }
};

Model operator+(const Model& a, const Model& b) {
  Model out(*a.space);
  out.r = a.r + b.r, out.d = a.d + b.d;
  out.p.reserve(a.p.size() + b.p.size());
  size_t i = 0, j = 0;
  while (i < a.p.size() || j < b.p.size()) {
    if (j == b.p.size() || (i < a.p.size() && a.p[i].key < b.p[j].key)) out.p.push_back(a.p[i++]);
    else if (i == a.p.size() || b.p[j].key < a.p[i].key) out.p.push_back(b.p[j++]);
    else {
      Z sum = a.p[i].c + b.p[j].c;
      if (sum != 0) out.p.push_back({a.p[i].key, sum});
      i++, j++;
    }
  }
  return out;
}

Model operator*(const Model& a, const Q& q) {
  Model out(*a.space);
  if (q == 0) return out;
  Q size = abs(q);
  auto scaled_up = [&](const Z& z) {
    Z product = z * size.get_num(), high;
    mpz_cdiv_q(high.get_mpz_t(), product.get_mpz_t(), size.get_den_mpz_t());
    return high;
  };
  out.r = scaled_up(a.r), out.d = scaled_up(a.d);
  for (auto& t : a.p) {
    Z product = t.c * q.get_num(), low, left;
    mpz_fdiv_qr(low.get_mpz_t(), left.get_mpz_t(), product.get_mpz_t(), q.get_den_mpz_t());
    if (left != 0) out.count(t.key, 1);
    if (low != 0) out.p.push_back({t.key, low});
  }
  return out;
}
Model operator-(const Model& a, const Model& b) { return a + b * Q(-1); }

// Sums by exponents, for products.
class Sums {
 public:
  explicit Sums(size_t expected) {
    size_t room = 64;
    while (room < 2 * expected) room *= 2;
    slots.assign(room, -1);
  }
  Z& at(Key key) {
    size_t i = KeyHash()(key) & (slots.size() - 1);
    while (slots[i] >= 0 && terms[size_t(slots[i])].key != key) i = (i + 1) & (slots.size() - 1);
    if (slots[i] >= 0) return terms[size_t(slots[i])].c;
    if (2 * terms.size() >= slots.size()) return grown(key);
    slots[i] = int(terms.size());
    terms.push_back({key, 0});
    return terms.back().c;
  }
  vector<Term> terms;

 private:
  vector<int> slots;
  Z& grown(Key key) {
    slots.assign(2 * slots.size(), -1);
    for (size_t t = 0; t < terms.size(); t++) {
      size_t i = KeyHash()(terms[t].key) & (slots.size() - 1);
      while (slots[i] >= 0) i = (i + 1) & (slots.size() - 1);
      slots[i] = int(t);
    }
    return at(key);
  }
};

Model operator*(const Model& a, const Model& b) {
  const Space& space = *a.space;
  for (int v = 0; v <= space.others(); v++) {
    int most[2] = {0, 0};
    for (auto& t : a.p) most[0] = std::max(most[0], exponent(t.key, v));
    for (auto& t : b.p) most[1] = std::max(most[1], exponent(t.key, v));
    if (most[0] + most[1] > 255) throw Undecided{"has polynomials of too high a degree: undecided"};
  }
  Sums sums(a.p.size() + b.p.size());
  for (auto& t : a.p)
    for (auto& u : b.p) mpz_addmul(sums.at(t.key + u.key).get_mpz_t(), t.c.get_mpz_t(), u.c.get_mpz_t());
  Model out(space);
  if (a.r != 0 || a.d != 0 || b.r != 0 || b.d != 0) {
    Z size_a = a.size(), size_b = b.size();
    out.r = shifted_up(size_a * b.r + size_b * a.r + a.r * (b.r + b.d) + a.d * b.r);
    out.d = shifted_up(size_a * b.d + size_b * a.d + a.d * b.d);
  }
  Z lost[2] = {0, 0};  // by whether they vanish with s, in 2^-3 BITS
  for (auto& t : sums.terms) {
    Key key = t.key;
    if (!space.has(key)) {
      lost[exponent(key, 0) > 0] += abs(t.c) * peak(space.y_part(key));
      continue;
    }
    Z low, left;
    mpz_fdiv_q_2exp(low.get_mpz_t(), t.c.get_mpz_t(), BITS);
    mpz_fdiv_r_2exp(left.get_mpz_t(), t.c.get_mpz_t(), BITS);
    if (left != 0) out.count(key, 1);
    if (low != 0) out.p.push_back({key, low});
  }
  out.d += shifted_up(shifted_up(lost[0]));
  out.r += shifted_up(shifted_up(lost[1]));
  std::sort(out.p.begin(), out.p.end(), [](const Term& x, const Term& y) { return x.key < y.key; });
  return out;
}

// The exact sum of terms, none dropped.
Model model(const Space& space, const std::map<Key, Q>& terms) {
  Model out(space);
  for (auto& [key, c] : terms) {
    bool exact;
    Z fixed = nearest(c, exact);
    if (!exact) out.count(key, 1);
    if (fixed != 0) out.p.push_back({key, fixed});
  }
  return out;
}
Model model(const Space& space, const Q& q) { return model(space, std::map<Key, Q>{{0, q}}); }
Model model(const Space& space, const Curve& curve, Key times = 0) {
  std::map<Key, Q> terms;
  for (size_t i = 0; i < curve.size(); i++)
    if (curve[i] != 0) terms[power(0, int(i)) + times] = curve[i];
  return model(space, terms);
}
vector<Model> models(const Space& space, const vector<Curve>& curves) {
  vector<Model> out;
  for (auto& curve : curves) out.push_back(model(space, curve));
  return out;
}
// sum_j row_j(s) y_j, times a power of s.
Model form(const Space& space, const vector<Curve>& row, int s_power = 0) {
  Model total(space);
  for (size_t j = 0; j < row.size(); j++) total = total + model(space, row[j], power(1 + int(j)) + power(0, s_power));
  return total;
}

// Sine and cosine ------------------------------------------------------------------------------------------------------

struct Known {
  Q center, sine, cosine, error;
};

// Sine and cosine of a number, |x| <= 64, by their series.
Known known(const Q& x) {
  Known out{x, 0, 0, Q(1, Z(1) << (BITS - 8))};
  Q term = 1;
  bool exact;
  for (long k = 0; k < 64 || abs(term) > Q(1, Z(1) << (BITS + 16)); k++) {
    Q signed_term = k / 2 % 2 ? Q(-term) : term;
    (k % 2 ? out.sine : out.cosine) += signed_term;
    term = term * x / Q(k + 1);
    Q fine(nearest(term, exact, 4 * BITS), Z(1) << (4 * BITS));
    fine.canonicalize();
    term = fine;
  }
  out.sine = exactly(nearest(out.sine, exact)), out.cosine = exactly(nearest(out.cosine, exact));
  return out;
}

// A polynomial in x of degree `degree` near a longer one on [-radius, radius], and a bound of the difference: the
// longer one's Chebyshev series, cut.
std::pair<Curve, Q> chebyshev_cut(const Curve& series, const Q& radius, int degree) {
  size_t count = series.size();
  Curve expansion(count);  // by T_0, T_1, .. of x / radius
  Q scale = 1;
  for (size_t k = 0; k < count; k++, scale *= radius) {
    Z binomial;
    for (size_t j = 0; 2 * j <= k; j++) {
      mpz_bin_uiui(binomial.get_mpz_t(), k, j);
      Q weight(2 * j == k ? binomial : Z(2 * binomial), Z(1) << k);
      weight.canonicalize();
      expansion[k - 2 * j] += series[k] * scale * weight;
    }
  }
  Curve before{1}, now{0, Q(1) / radius}, total;
  Q lost = 0;
  for (size_t k = 0; k < count; k++) {
    const Curve& basis = k == 0 ? before : now;
    if (int(k) <= degree) total = total + basis * expansion[k];
    else lost += abs(expansion[k]);
    if (k > 0) {
      Curve after = Curve{0, Q(2) / radius} * now - before;
      before = now, now = after;
    }
  }
  return {total, lost};
}

// Of an angle whose distance from a known one is small.
std::pair<Model, Model> sine_and_cosine(const Model& angle, const Known& near, const string& place) {
  const Space& space = *angle.space;
  Model x = angle - model(space, near.center);
  Z off_r = x.r, off_d = x.d;  // both have slopes of at most 1
  x.r = x.d = 0;
  bool exact;
  Q radius(nearest(exactly(x.size()) + Q(1, 1 << 21), exact, 20), 1 << 20);
  radius.canonicalize();
  radius = std::max(radius, Q(1, 1 << 20));
  require(radius <= 8, place, "the funnel is wider than 8 rad");
  constexpr int LONG = 31;
  Curve sine(LONG), cosine(LONG);  // of sin(x) / x and (cos(x) - 1) / x
  Z factorial = 1;
  Q tail = 1;
  for (int k = 0; k < LONG; k++, tail *= radius) {
    factorial *= k + 1;
    Q part(1, factorial);
    if (k % 2 == 0) sine[size_t(k)] = k / 2 % 2 ? Q(-part) : part;
    else cosine[size_t(k)] = (k + 1) / 2 % 2 ? Q(-part) : part;
  }
  tail /= Q(factorial * (LONG + 1));
  Model squared = x * x;
  auto part = [&](const Curve& series, bool odd) {
    auto [cut, lost] = chebyshev_cut(series, radius, space.y_order - 1);
    Model total(space);
    for (int k = int(cut.size()) - 1; k >= 0; k--) {
      if (k % 2 != int(odd)) continue;
      total = total * squared + model(space, cut[size_t(k)]);
    }
    total = odd ? total * x * x : total * x;
    total.r += up(radius * (lost + tail));
    return total;
  };
  Model s = part(sine, false), c = part(cosine, true) + model(space, Q(1));
  Z wrong_d = off_d + up(3 * near.error);
  auto turned = [&](const Model& f) {
    Model out = f;
    out.r += off_r, out.d += wrong_d;
    return out;
  };
  return {turned(s * near.cosine + c * near.sine), turned(c * near.cosine - s * near.sine)};
}

// Robots ---------------------------------------------------------------------------------------------------------------
//
// Functions of the positions are sums of (cosine cos(k.q) + sine sin(k.q)) q^e times powers of the robot's numbers.

using Powers = vector<std::pair<string, int>>;
using Joints = vector<int>;  // by joint: k of a hinge, e of a slide
using Function = vector<std::tuple<Joints, Powers, Q, Q>>;

// Sums of terms; what cancels is gone.
struct Collected {
  std::map<std::pair<Joints, Powers>, std::pair<Q, Q>> terms;
  vector<std::pair<Joints, Powers>> order;

  void add(const Joints& joints, const Powers& powers, const Q& cosine, const Q& sine) {
    auto key = std::make_pair(joints, powers);
    if (!terms.count(key)) order.push_back(key);
    auto& [c, s] = terms[key];
    c += cosine, s += sine;
  }
  Function function() const {
    Function out;
    for (auto& key : order) {
      auto& [c, s] = terms.at(key);
      if (c != 0 || s != 0) out.push_back({key.first, key.second, c, s});
    }
    return out;
  }
};

struct Robot {
  string name, input_unit;
  vector<string> states, units;
  vector<bool> hinge;
  vector<vector<Function>> mass;  // [i][j <= i]
  Function potential;
  vector<Function> damping, motor;
  vector<Function> slopes;                                          // dU/dq_i
  vector<vector<std::tuple<size_t, size_t, Function>>> christoffel;  // c_i = sum of f v_j v_k, j <= k
  vector<Joints> waves;                                             // all k but zero

  size_t joints() const { return hinge.size(); }
  const Function& entry(size_t i, size_t j) const { return mass[std::max(i, j)][std::min(i, j)]; }

  Joints wave(const Joints& each) const {
    Joints k = each;
    for (size_t i = 0; i < k.size(); i++)
      if (!hinge[i]) k[i] = 0;
    return k;
  }

  // Adds factor d/dq_by of a function.
  void differentiate(const Function& f, size_t by, const Q& factor, Collected& into) const {
    for (auto& [joints, powers, cosine, sine] : f) {
      Q k = factor * joints[by];
      if (k == 0) continue;
      if (hinge[by]) {
        into.add(joints, powers, sine * k, cosine * -k);
      } else {
        Joints lowered = joints;
        lowered[by]--;
        into.add(lowered, powers, cosine * k, sine * k);
      }
    }
  }

  // Lagrange's equations: c_i = sum_jk (dM_ij/dq_k - 1/2 dM_jk/dq_i) v_j v_k.
  void derive() {
    size_t n = joints();
    for (size_t i = 0; i < n; i++) {
      Collected by;
      differentiate(potential, i, 1, by);
      slopes.push_back(by.function());
      christoffel.emplace_back();
      for (size_t k = 0; k < n; k++)
        for (size_t j = 0; j <= k; j++) {
          Collected factor;
          differentiate(entry(i, j), k, 1, factor);
          if (j < k) differentiate(entry(i, k), j, 1, factor);
          differentiate(entry(j, k), i, j < k ? Q(-1) : Q(-1, 2), factor);
          if (Function f = factor.function(); !f.empty()) christoffel[i].push_back({j, k, f});
        }
    }
    std::set<Joints> all;
    auto collect = [&](const Function& f) {
      for (auto& term : f) all.insert(wave(std::get<0>(term)));
    };
    for (auto& row : mass)
      for (auto& f : row) collect(f);
    collect(potential);
    for (auto& k : all)
      if (std::any_of(k.begin(), k.end(), [](int a) { return a != 0; })) waves.push_back(k);
  }

  std::set<string> numbers() const {
    std::set<string> names;
    auto collect = [&](const Function& f) {
      for (auto& term : f)
        for (auto& power : std::get<1>(term)) names.insert(power.first);
    };
    for (auto& row : mass)
      for (auto& f : row) collect(f);
    collect(potential);
    for (auto& f : damping) collect(f);
    for (auto& f : motor) collect(f);
    return names;
  }
};

// A Model and its rate along a direction.
struct Moving {
  Model value, rate;
};
Moving operator+(const Moving& a, const Moving& b) { return {a.value + b.value, a.rate + b.rate}; }
Moving operator*(const Moving& a, const Moving& b) { return {a.value * b.value, a.rate * b.value + b.rate * a.value}; }
Moving operator*(const Moving& a, const Q& q) { return {a.value * q, a.rate * q}; }

template <class T>
struct Field {  // D x' = a + b (u + w)
  T d;
  vector<T> a, b;
};

// A function at the positions x, with sine and cosine of k.q by k. `exact` has the numbers that are known, `uncertain`
// the others.
template <class T>
T evaluated(const Robot& robot, const Function& f, const std::map<string, Q>& exact, const std::map<string, T>& uncertain,
            const vector<T>& x, const std::map<Joints, std::pair<T, T>>& waves, const T& one) {
  T total = one * Q(0);
  for (auto& [joints, powers, cosine, sine] : f) {
    Joints k = robot.wave(joints);
    T part = one * cosine;
    if (auto found = waves.find(k); found != waves.end())
      part = cosine == 0 ? found->second.first * sine
             : sine == 0 ? found->second.second * cosine
                         : found->second.second * cosine + found->second.first * sine;
    Q factor = 1;
    std::optional<T> among;  // the uncertain ones' product
    for (auto& [name, e] : powers)
      for (int i = 0; i < e; i++) {
        if (auto given = exact.find(name); given != exact.end()) factor *= given->second;
        else among = among ? *among * uncertain.at(name) : uncertain.at(name);
      }
    part = among ? part * (*among * factor) : part * factor;
    for (size_t i = 0; i < robot.joints(); i++)
      if (!robot.hinge[i])
        for (int e = 0; e < joints[i]; e++) part = part * x[i];
    total = total + part;
  }
  return total;
}

// The whole matrix of which `lower` has the triangle.
template <class T, class F>
vector<vector<T>> symmetric(const vector<vector<Function>>& lower, F value) {
  size_t n = lower.size();
  vector<vector<T>> full(n);
  for (size_t i = 0; i < n; i++)
    for (size_t j = 0; j < n; j++) full[i].push_back(j <= i ? value(lower[i][j]) : full[0][0]);
  for (size_t i = 0; i < n; i++)
    for (size_t j = i + 1; j < n; j++) full[i][j] = full[j][i];
  return full;
}

// At the states x.
template <class T>
Field<T> field(const Robot& robot, const std::map<string, Q>& exact, const std::map<string, T>& uncertain,
               const vector<T>& x, const std::map<Joints, std::pair<T, T>>& waves, const T& one) {
  size_t n = robot.joints();
  auto value = [&](const Function& f) { return evaluated(robot, f, exact, uncertain, x, waves, one); };
  vector<vector<T>> mass = symmetric<T>(robot.mass, value);
  vector<T> forces, motor;
  for (size_t i = 0; i < n; i++) {
    T force = value(robot.slopes[i]) * Q(-1) + value(robot.damping[i]) * x[n + i] * Q(-1);
    for (auto& [j, k, f] : robot.christoffel[i]) force = force + value(f) * x[n + j] * x[n + k] * Q(-1);
    forces.push_back(force);
    motor.push_back(value(robot.motor[i]));
  }
  auto [adjugate, determinant] = cofactors(mass, one);
  Field<T> out{determinant, {}, {}};
  for (size_t i = 0; i < n; i++) out.a.push_back(determinant * x[n + i]), out.b.push_back(one * Q(0));
  for (size_t i = 0; i < n; i++) out.a.push_back(dot(adjugate[i], forces)), out.b.push_back(dot(adjugate[i], motor));
  return out;
}

// Positivity -----------------------------------------------------------------------------------------------------------

Z binomial(unsigned long n, unsigned long k) {
  Z out;
  mpz_bin_uiui(out.get_mpz_t(), n, k);
  return out;
}
Q ratio(const Z& a, const Z& b) {
  Q q(a, b);
  q.canonicalize();
  return q;
}

// Row k: x^k in the Bernstein polynomials of a degree on [low, high].
Matrix bernstein_of_powers(int order, int degree, const Q& low, const Q& high) {
  Matrix rows(size_t(order) + 1, Row(size_t(degree) + 1));
  Q width = high - low;
  // x = low + width t, and t^i = sum_j C(j, i) / C(degree, i) B_j(t)
  Matrix in_t(size_t(order) + 1, Row(size_t(order) + 1));
  in_t[0][0] = 1;
  for (size_t k = 1; k <= size_t(order); k++)
    for (size_t i = 0; i <= k; i++) in_t[k][i] = low * in_t[k - 1][i] + (i ? Q(width * in_t[k - 1][i - 1]) : Q(0));
  for (size_t k = 0; k <= size_t(order); k++)
    for (size_t j = 0; j <= size_t(degree); j++)
      for (size_t i = 0; i <= std::min(j, k); i++)
        if (in_t[k][i] != 0) rows[k][j] += in_t[k][i] * ratio(binomial(j, i), binomial(size_t(degree), i));
  return rows;
}

// A polynomial on a box in Bernstein form, all coefficients.
struct Tensor {
  vector<size_t> size;  // degree + 1 by variable, the last runs fastest
  Row c;

  void along(size_t axis, const std::function<void(vector<Q*>&)>& change) {
    size_t stride = 1, length = size[axis];
    for (size_t i = axis + 1; i < size.size(); i++) stride *= size[i];
    vector<Q*> line(length);
    for (size_t from = 0; from < c.size(); from++) {
      if (from / stride % length) continue;
      for (size_t i = 0; i < length; i++) line[i] = &c[from + i * stride];
      change(line);
    }
  }

  bool a_corner_is_not_positive() const {
    vector<size_t> corners{0};
    for (size_t axis = 0; axis < size.size(); axis++) {
      size_t count = corners.size();
      for (size_t i = 0; i < count; i++) {
        size_t here = corners[i] * size[axis];
        corners[i] = here;
        if (size[axis] > 1) corners.push_back(here + size[axis] - 1);
      }
    }
    return std::any_of(corners.begin(), corners.end(), [&](size_t i) { return c[i] <= 0; });
  }

  // The halves by de Casteljau.
  std::pair<Tensor, Tensor> halves(size_t axis) const {
    Tensor left = *this, right = *this;
    auto split = [](vector<Q*>& line, bool keep_left) {
      size_t n = line.size();
      Row work;
      for (Q* q : line) work.push_back(*q);
      for (size_t round = 0; round < n; round++) {
        if (keep_left) *line[round] = work[0];
        else *line[n - 1 - round] = work[n - 1 - round];
        for (size_t i = 0; i + 1 + round < n; i++) work[i] = (work[i] + work[i + 1]) / 2;
      }
    };
    left.along(axis, [&](auto& line) { split(line, true); });
    right.along(axis, [&](auto& line) { split(line, false); });
    return {left, right};
  }

  bool positive(const Row& width, int depth) const {
    if (std::all_of(c.begin(), c.end(), [](const Q& q) { return q > 0; })) return true;
    std::optional<size_t> widest;
    for (size_t i = 0; i < size.size(); i++)
      if (size[i] > 1 && (!widest || width[i] > width[*widest])) widest = i;
    if (!widest || depth == 0 || a_corner_is_not_positive()) return false;
    Row narrower = width;
    narrower[*widest] /= 2;
    auto [left, right] = halves(*widest);
    return left.positive(narrower, depth - 1) && right.positive(narrower, depth - 1);
  }
};

using Exact = std::map<vector<int>, Q>;  // exponents -> coefficient

bool is_positive(const Exact& p, const vector<std::pair<Q, Q>>& box, int depth = DEPTH) {
  Tensor tensor;
  double room = 1;
  for (size_t i = 0; i < box.size(); i++) {
    int degree = 0;
    for (auto& [e, c] : p)
      if (c != 0) degree = std::max(degree, e[i]);
    tensor.size.push_back(size_t(degree) + 1);
    room *= degree + 1;
  }
  if (room > MOST_COEFFICIENTS) throw Undecided{"needs more memory than there is: undecided"};
  tensor.c.resize(size_t(room));
  for (auto& [e, c] : p) {
    if (c == 0) continue;
    size_t at = 0;
    for (size_t i = 0; i < box.size(); i++) at = at * tensor.size[i] + size_t(e[i]);
    tensor.c[at] += c;
  }
  Row width;
  for (size_t i = 0; i < box.size(); i++) {
    int degree = int(tensor.size[i]) - 1;
    width.push_back(box[i].second - box[i].first);
    Matrix rows = bernstein_of_powers(degree, degree, box[i].first, box[i].second);
    tensor.along(i, [&](vector<Q*>& line) {
      Row changed(line.size());
      for (size_t k = 0; k < line.size(); k++)
        if (*line[k] != 0)
          for (size_t j = 0; j < line.size(); j++) changed[j] += *line[k] * rows[k][j];
      for (size_t j = 0; j < line.size(); j++) *line[j] = changed[j];
    });
  }
  return tensor.positive(width, depth);
}

bool is_positive(const Curve& p, const Q& low = -1, const Q& high = 1, int depth = DEPTH) {
  Exact terms;
  for (size_t i = 0; i < p.size(); i++) terms[{int(i)}] = p[i];
  return is_positive(terms, {{low, high}}, depth);
}

// Exact polynomials in several variables, for det M alone.
Exact operator+(const Exact& a, const Exact& b) {
  Exact out = a;
  for (auto& [e, c] : b) out[e] += c;
  return out;
}
Exact operator*(const Exact& a, const Exact& b) {
  Exact out;
  for (auto& [e, c] : a)
    for (auto& [f, d] : b) {
      vector<int> g = e;
      for (size_t i = 0; i < g.size(); i++) g[i] += f[i];
      out[g] += c * d;
    }
  for (auto i = out.begin(); i != out.end();) i = i->second == 0 ? out.erase(i) : std::next(i);
  return out;
}
Exact operator*(const Exact& a, const Q& q) {
  Exact out = a;
  for (auto& [e, c] : out) c *= q;
  return out;
}

using Box = std::map<string, std::pair<Q, Q>>;

// Whether det M > 0 for all positions and all numbers of the box, where M does not depend on a slide. Every angle is
// +-2 atan(t) from 0 or from pi with |t| <= 1: cos = +-(1 - t^2) / (1 + t^2), sin = +-2 t / (1 + t^2), so that
// e^(ikq) is (+-(1 + it)^2)^k / (1 + t^2)^k, and det M a polynomial over a positive one.
bool mass_is_definite(const Robot& robot, const Box& box) {
  vector<size_t> turning;
  vector<int> most;
  for (size_t i = 0; i < robot.joints(); i++) {
    int highest = 0;
    for (auto& row : robot.mass)
      for (auto& f : row)
        for (auto& term : f) highest = std::max(highest, std::abs(std::get<0>(term)[i]));
    if (highest == 0) continue;
    if (!robot.hinge[i]) return false;
    turning.push_back(i), most.push_back(highest);
  }
  vector<string> uncertain;
  for (auto& [name, ends] : box)
    if (ends.first < ends.second) uncertain.push_back(name);
  size_t variables = turning.size() + uncertain.size();
  vector<int> none(variables, 0);
  auto variable = [&](size_t i) {
    vector<int> e = none;
    e[i] = 1;
    return Exact{{e, Q(1)}};
  };
  Exact one{{none, Q(1)}};
  std::map<string, Exact> numbers;
  for (auto& [name, ends] : box) numbers[name] = one * ends.first;
  for (size_t i = 0; i < uncertain.size(); i++) {
    auto& [low, high] = box.at(uncertain[i]);
    numbers[uncertain[i]] = one * Q((low + high) / 2) + variable(turning.size() + i) * Q((high - low) / 2);
  }
  vector<std::pair<Q, Q>> cube(variables, {Q(-1), Q(1)});
  for (size_t chart = 0; chart < size_t(1) << turning.size(); chart++) {
    auto value = [&](const Function& f) {
      Exact total{{none, Q(0)}};
      for (auto& [joints, powers, cosine, sine] : f) {
        Exact real = one, imaginary = one * Q(0);
        for (size_t place = 0; place < turning.size(); place++) {
          int k = joints[turning[place]];
          Exact t = variable(place), round = one + t * t;
          Q sign = chart >> place & 1 ? -1 : 1;
          Exact c = (one + t * t * Q(-1)) * sign, s = t * Q(k < 0 ? -2 : 2) * sign;
          for (int i = 0; i < std::abs(k); i++) {
            Exact turned = real * c + imaginary * s * Q(-1);
            imaginary = real * s + imaginary * c;
            real = turned;
          }
          for (int i = std::abs(k); i < most[place]; i++) real = real * round, imaginary = imaginary * round;
        }
        Exact part = real * cosine + imaginary * sine;
        for (auto& [name, e] : powers)
          for (int i = 0; i < e; i++) part = part * numbers.at(name);
        total = total + part;
      }
      return total;
    };
    size_t n = robot.joints();
    vector<vector<Exact>> mass(n, vector<Exact>(n));
    for (size_t i = 0; i < n; i++)
      for (size_t j = 0; j <= i; j++) mass[i][j] = mass[j][i] = value(robot.mass[i][j]);
    if (!is_positive(cofactors(mass, one).second, cube)) return false;
  }
  return true;
}

// All leading minors are positive (Sylvester), by fraction-free elimination in integers.
bool is_positive_definite(const Matrix& m) {
  Z common = 1;
  for (auto& row : m)
    for (auto& c : row) mpz_lcm(common.get_mpz_t(), common.get_mpz_t(), c.get_den_mpz_t());
  size_t n = m.size();
  vector<vector<Z>> a(n, vector<Z>(n));
  for (size_t i = 0; i < n; i++)
    for (size_t j = 0; j < n; j++) a[i][j] = m[i][j].get_num() * (common / m[i][j].get_den());
  Z before = 1;
  for (size_t k = 0; k < n; k++) {
    if (a[k][k] <= 0) return false;
    for (size_t i = k + 1; i < n; i++)
      for (size_t j = i; j < n; j++) {
        Z minor = a[k][k] * a[i][j] - a[k][i] * a[k][j];
        mpz_divexact(a[i][j].get_mpz_t(), minor.get_mpz_t(), before.get_mpz_t());
      }
    before = a[k][k];
  }
  return true;
}

// Sums of squares ------------------------------------------------------------------------------------------------------

using InY = std::unordered_map<Key, Q, KeyHash>;  // exponents of y, the first in the lowest byte -> coefficient

struct Gram {
  int degree = 0;
  vector<Matrix> gram;
  vector<vector<Matrix>> multipliers;
  vector<Key> further;  // monomials of the squares beside those up to the degree
  vector<Gram> halves;  // two, one of each half in s, in the place of all that
};

// To show: q > 0 where |y| = 1, s in [low, high] and all `where` >= 0; q is within `error` of p, a polynomial by s and y.
struct Obligation {
  vector<std::pair<Key, Q>> p;
  Q error, drift;
  vector<vector<std::pair<Key, Q>>> where;
  Q low, high;
};

// Exponents up to a degree: by degree, then in the order of combinations with replacement, at most one of the last.
vector<Key> monomials(int n, int degree) {
  vector<Key> basis;
  std::function<void(int, int, Key)> extend = [&](int left, int from, Key key) {
    if (left == 0) {
      if (exponent(key, n - 1) < 2) basis.push_back(key);
      return;
    }
    for (int i = from; i < n; i++) extend(left - 1, i, key + power(i));
  };
  for (int order = 0; order <= degree; order++) extend(order, 0, 0);
  return basis;
}

// y^e on the sphere, where y_n^2 = 1 - y_1^2 - .. - y_{n-1}^2.
const vector<std::pair<Key, Z>>& on_sphere(Key e, int n) {
  static std::unordered_map<Key, vector<std::pair<Key, Z>>, KeyHash> memory[2 * MOST_JOINTS + 1];
  auto& known = memory[n];
  if (auto found = known.find(e); found != known.end()) return found->second;
  std::map<Key, Z> total;
  if (exponent(e, n - 1) < 2) {
    total[e] = 1;
  } else {
    Key rest = e - power(n - 1, 2);
    for (auto& [f, c] : on_sphere(rest, n)) total[f] += c;
    for (int i = 0; i + 1 < n; i++)
      for (auto& [f, c] : on_sphere(rest + power(i, 2), n)) total[f] -= c;
  }
  vector<std::pair<Key, Z>> list;
  for (auto& term : total)
    if (term.second != 0) list.push_back(term);
  return known.emplace(e, list).first->second;
}

// Coefficients in the Bernstein polynomials of s, each a polynomial in y on the sphere, and by how much p may differ from
// them: what is beyond their degree is cut from its Chebyshev series.
std::pair<vector<InY>, Q> in_bernstein(const vector<std::pair<Key, Q>>& p, int n, int degree, const Q& low, const Q& high) {
  size_t order = 0;
  for (auto& [key, c] : p) order = std::max(order, size_t(exponent(key, 0)));
  bool cut = order > size_t(degree);
  Matrix rows = bernstein_of_powers(cut ? degree : int(order), degree, cut ? Q(-1) : low, cut ? Q(1) : high);
  std::unordered_map<Key, Curve, KeyHash> by_y;
  for (auto& [key, c] : p)
    for (auto& [f, k] : on_sphere(key >> 8, n)) {
      Curve& powers = by_y[f];
      powers.resize(order + 1);
      powers[size_t(exponent(key, 0))] += c * k;
    }
  vector<InY> parts(size_t(degree) + 1);
  Q error = 0;
  Curve argument{(low + high) / 2, (high - low) / 2};  // s of a time that goes from -1 to 1
  for (auto& [f, powers] : by_y) {
    if (cut) {
      auto [kept, lost] = chebyshev_cut(at(powers, argument), 1, degree);
      powers = kept;
      error += lost * exactly(peak(f));
    }
    for (size_t k = 0; k < powers.size(); k++)
      for (size_t j = 0; j < parts.size(); j++)
        if (powers[k] != 0 && rows[k][j] != 0) parts[j][f] += powers[k] * rows[k][j];
  }
  return {parts, error};
}

// z' S z on the sphere.
InY quadratic(const Matrix& s, const vector<Key>& z, int n) {
  InY total;
  for (size_t i = 0; i < z.size(); i++)
    for (size_t j = i; j < z.size(); j++)
      for (auto& [f, k] : on_sphere(z[i] + z[j], n)) total[f] += s[i][j] * k * (i == j ? 1 : 2);
  return total;
}

void require_definite(const Matrix& m, size_t rows, const string& place) {
  require(m.size() == rows, place, "has another number of rows");
  require(is_positive_definite(m), place, "is not positive definite");
}

// A lower bound > 0 of q where the obligation asks for it.
Q margin(const Obligation& todo, const Gram& proof, int n, const string& place) {
  if (!proof.halves.empty()) {
    Obligation first = todo, second = todo;
    first.high = second.low = (todo.low + todo.high) / 2;
    Q least = margin(first, proof.halves[0], n, place + "[0]");
    return std::min(least, margin(second, proof.halves[1], n, place + "[1]"));
  }
  auto z = monomials(n, proof.degree), lower = monomials(n, proof.degree - 1);
  z.insert(z.end(), proof.further.begin(), proof.further.end());
  int degree = int(proof.gram.size()) - 1;
  auto [parts, error] = in_bernstein(todo.p, n, degree, todo.low, todo.high);
  require(proof.multipliers.size() == todo.where.size(), place, "needs " + std::to_string(todo.where.size()) + " multipliers");
  for (size_t i = 0; i < todo.where.size(); i++) {
    string here = place + ".multipliers[" + std::to_string(i) + "]";
    auto& sigma = proof.multipliers[i];
    int high = int(sigma.size()) - 1;
    require(high >= 0 && high <= degree, here, "has " + std::to_string(high + 1) + " matrices, must have 1 to " + std::to_string(degree + 1));
    auto [g, above] = in_bernstein(todo.where[i], n, degree - high, todo.low, todo.high);
    for (auto& part : g) part[0] += above;  // the condition holds wherever it did
    for (size_t a = 0; a < sigma.size(); a++) {
      require_definite(sigma[a], lower.size(), here + "[" + std::to_string(a) + "]");
      auto square = quadratic(sigma[a], lower, n);
      for (size_t b = 0; b < g.size(); b++) {
        // B_a B_b = C(high, a) C(rest, b) / C(degree, a + b) B_(a + b)
        Q weight = ratio(binomial(size_t(high), a) * binomial(size_t(degree - high), b), binomial(size_t(degree), a + b));
        InY product;
        for (auto& [e, c] : square)
          for (auto& [f, d] : g[b]) product[e + f] += c * d;
        for (auto& [h, c] : product) {
          Q scaled = c * weight;
          for (auto& [f, k] : on_sphere(h, n)) parts[a + b][f] -= scaled * k;
        }
      }
    }
  }
  std::optional<Q> least;
  for (size_t j = 0; j < parts.size(); j++) {
    string here = place + ".gram[" + std::to_string(j) + "]";
    require_definite(proof.gram[j], z.size(), here);
    for (auto& [f, c] : quadratic(proof.gram[j], z, n)) parts[j][f] -= c;
    Q rest = -todo.error - error;
    for (auto& [f, c] : parts[j]) rest += f == 0 ? c : Q(-abs(c) * exactly(peak(f)));
    require(rest > 0, here, "proves no decrease: at best " + formatted("%.3g", rounded(rest)) + ", must be > 0");
    if (!least || rest < *least) least = rest;
  }
  return *least;
}

// The claim ------------------------------------------------------------------------------------------------------------

// A set to keep out of: {x : normal'x > offset}, or {x : sum_i ((x_i - center_i) / semi_axes_i)^2 < 1}.
struct KeptOut {
  bool half = false;
  Row normal, center;
  Q offset;
  vector<std::optional<Q>> semi_axes;  // without one: infinite

  // An upper bound of the largest w'(x - center) in the ellipsoid.
  Q support(const Row& w) const {
    Q square = 0;
    for (size_t i = 0; i < w.size(); i++)
      if (semi_axes[i]) square += *semi_axes[i] * *semi_axes[i] * w[i] * w[i];
    return exactly(root_up(square));
  }
};

// A part of c_p - x*: a product of powers of p, by the uncertain numbers, times cubics by their values and rates.
struct Shift {
  vector<int> powers;
  Matrix x;
  vector<Matrix> rates;
};

// Where the motion ends: in {center + axes y : |y| <= 1}, or in what a reset leads into it: q+ = positions q + pi turns,
// M+(q+) v+ = momentum(q) v, M+ of the same robot whose numbers are then these: other ones' values, or exact ones.
struct Catch {
  Row center;
  Matrix axes;
  bool resets = false;
  vector<Joints> positions;
  Joints turns;
  std::map<string, string> renamed;
  std::map<string, Q> exact;
  vector<vector<Function>> momentum;
};

struct Claim {
  Robot robot;
  vector<std::pair<string, std::pair<Q, Q>>> parameters;  // in the file's order
  Box box;
  std::pair<Q, Q> limits;
  Q disturbance, age, speed, jerk, reaction, dt, start, push;
  Row noise, jumps, u, x_goal, k_goal;
  bool first_order = false;
  vector<std::optional<Q>> bounds;
  Matrix x, k;
  vector<Matrix> rates;
  long first_knot = 0;
  vector<string> uncertain;
  vector<KeptOut> keep_out;
  vector<Shift> shifts;
  std::optional<Catch> caught;  // x_goal and k_goal are empty then

  bool constant() const { return first_order || !shifts.empty(); }  // whether the numbers do not vary in time
  size_t ellipsoids() const {
    return size_t(std::count_if(keep_out.begin(), keep_out.end(), [](const KeptOut& each) { return !each.half; }));
  }
  size_t n() const { return robot.states.size(); }
  bool moves_the_goal() const {
    return disturbance != 0 || age != 0 || std::any_of(noise.begin(), noise.end(), [](const Q& e) { return e != 0; });
  }
  Space space(int s_order, int y_order, int stride = 0) const { return {int(n()), int(uncertain.size()), s_order, y_order, stride}; }

  std::map<string, Q> exact() const {
    std::map<string, Q> out;
    for (auto& [name, ends] : box)
      if (ends.first == ends.second) out[name] = ends.first;
    return out;
  }
  std::map<string, Model> between(const Space& space) const {
    std::map<string, Model> out;
    for (size_t i = 0; i < uncertain.size(); i++) {
      auto& [low, high] = box.at(uncertain[i]);
      Key p = power(1 + space.n + int(i));
      out.emplace(uncertain[i], model(space, std::map<Key, Q>{{0, (low + high) / 2}, {p, (high - low) / 2}}));
    }
    return out;
  }

  // The first knot whose gains may act on interval k.
  long oldest(long knot) const {
    Q count = age / dt;
    Z whole;
    mpz_cdiv_q(whole.get_mpz_t(), count.get_num_mpz_t(), count.get_den_mpz_t());
    return whole >= knot ? 0 : knot - whole.get_si();
  }
  // A bound of the feedback's error: by noise, and by how far it moves in the age of a measurement.
  Q error(const Matrix& gains) const {
    Q total = age * speed;
    for (size_t i = 0; i < n(); i++) {
      Q largest = 0;
      for (auto& row : gains) largest = std::max(largest, Q(abs(row[i])));
      total += largest * noise[i];
    }
    return total;
  }
  Q error_on(long knot) const { return error(Matrix(k.begin() + oldest(knot), k.begin() + knot + 2)); }
};

using Waves = std::map<Joints, Known>;

template <class T>
T angle_of(const Joints& k, const vector<T>& x) {
  std::optional<T> total;
  for (size_t i = 0; i < k.size(); i++)
    if (k[i]) total = total ? *total + x[i] * Q(k[i]) : T(x[i] * Q(k[i]));
  return *total;
}

// The robots' equations on an ellipsoid.
struct Here {
  const Claim* claim;
  const Space* space;
  vector<Model> x;
  std::map<Joints, std::pair<Model, Model>> waves;
  Field<Model> f;

  Here(const Claim& c, const Space& s, const vector<Model>& states, const Waves& near, const string& place)
      : claim(&c), space(&s), x(states), f{Model(s), {}, {}} {
    for (auto& [k, value] : near) waves.emplace(k, sine_and_cosine(angle_of(k, x), value, place));
    f = field<Model>(c.robot, c.exact(), c.between(s), x, waves, model(s, Q(1)));
  }

  // D, a and b along a direction of the states.
  Field<Model> rates(const vector<Model>& direction) const {
    Model nothing(*space), one = model(*space, Q(1));
    vector<Moving> moving;
    for (size_t i = 0; i < x.size(); i++) moving.push_back({x[i], direction[i]});
    std::map<Joints, std::pair<Moving, Moving>> turning;
    for (auto& [k, both] : waves) {
      Model spin = angle_of(k, direction);
      turning.insert({k, {Moving{both.first, both.second * spin}, Moving{both.second, both.first * spin * Q(-1)}}});
    }
    std::map<string, Moving> constant;
    for (auto& [name, value] : claim->between(*space)) constant.insert({name, Moving{value, nothing}});
    auto g = field<Moving>(claim->robot, claim->exact(), constant, moving, turning, Moving{one, nothing});
    Field<Model> out{g.d.rate, {}, {}};
    for (auto& each : g.a) out.a.push_back(each.rate);
    for (auto& each : g.b) out.b.push_back(each.rate);
    return out;
  }
};

Waves waves_near(const vector<Joints>& waves, const vector<Model>& x, const string& place) {
  Waves near;
  for (auto& k : waves) {
    bool exact;
    Q center(nearest(exactly(angle_of(k, x).constant()), exact, 20), 1 << 20);
    center.canonicalize();
    require(abs(center) <= 64, place, "the nominal angle is beyond 64 rad");
    near.emplace(k, known(center));
  }
  return near;
}

const Q PI = ratio(Z("314159265358979323846264338327950288419716939937510"), Z("1" + string(50, '0')));
const Q PI_ERROR = ratio(1, Z("1" + string(49, '0')));

// Angles at the goal are multiples of pi, rounded to doubles: there sine and cosine are 0 and +-1, up to the rounding.
Waves waves_at_goal(const Claim& claim, const string& place) {
  Waves near;
  for (auto& k : claim.robot.waves) {
    Q center = angle_of(k, claim.x_goal);
    Z turns = 0;
    if (abs(center) < MOST_TURNS) {
      Q half = center / PI + Q(1, 2);
      mpz_fdiv_q(turns.get_mpz_t(), half.get_num_mpz_t(), half.get_den_mpz_t());
    }
    Q off = abs(Q(center - PI * turns)) + PI_ERROR * abs(turns);
    require(off < Q(1, 1000000000), place, "the goal's angle is no multiple of pi");
    near.emplace(k, Known{center, 0, turns % 2 == 0 ? 1 : -1, off / 3});
  }
  return near;
}

// The input ------------------------------------------------------------------------------------------------------------
//
// With an error of at most e in u_lin, limits F in [F-, F+] and |w| <= W, the input lies between the saturated laws
// clip(u_lin - e, -F+, F-) - W and clip(u_lin + e, -F-, F+) + W; q is affine in it.

struct Case {
  vector<Curve> where_constant;       // conditions g >= 0 as a curve + sign linear
  vector<int> where_sign;
  Curve input;                        // what does not depend on y
  bool saturated = false, late = false;
};

template <class T>
using Named = vector<std::pair<string, T>>;  // in the order in which they are decided

// u_lin = feedforward + linear + what is the robot's own and at most `apart`; |linear|^2 <= square on the sphere. A
// condition holds where it does for one robot. `late` marks the law of the oldest measurement. Laws that differ in the
// limit alone are both free where |u_lin| <= F+ at most: if `joined`, in one case.
void add_cases(Named<Case>& cases, const Claim& claim, const Q& error, const Q& feedforward, const Curve& square,
               const Q& low, const Q& high, bool late, bool joined, const Q& apart = 0) {
  struct Law {
    string name;
    Q shift, floor, ceiling, on_top;
    bool free, limited;
  };
  auto& [weak, strong] = claim.limits;
  const Q& w = claim.disturbance;
  bool exact = error == 0 && w == 0, one_law = exact && weak == strong, one_free = one_law || (exact && joined);
  vector<Law> laws{{"", 0, strong, strong, 0, one_free, one_law},
                   {"-", -error, strong, weak, -w, !one_free, !one_law},
                   {"+", error, weak, strong, w, !one_free, !one_law}};
  for (auto& law : laws) {
    if (!law.free && !law.limited) continue;
    string name = law.name + (late ? "late" : "");
    Q middle = feedforward + law.shift;
    auto occurs = [&](const Q& room) {
      return !(room > 0 && is_positive(Curve{room * room} - square, low, high, DEPTH_OF_CASES));
    };
    Case free;
    Named<Case> at_limits;
    free.input = {middle + law.on_top}, free.late = late;
    for (bool above : {true, false}) {
      Q room = above ? Q(law.ceiling - middle) : Q(law.floor + middle);
      if (!occurs(room - apart)) continue;
      // free: room -+ linear >= 0; saturated: the opposite
      free.where_constant.push_back({room + apart}), free.where_sign.push_back(above ? -1 : 1);
      Case at_limit;
      at_limit.where_constant = {Curve{apart - room}}, at_limit.where_sign = {above ? 1 : -1};
      at_limit.input = {above ? Q(law.ceiling + law.on_top) : Q(law.on_top - law.floor)};
      at_limit.saturated = true, at_limit.late = late;
      at_limits.push_back({(above ? "high" : "low") + name, at_limit});
    }
    if (law.free) cases.push_back({"free" + name, free});
    if (law.limited) cases.insert(cases.end(), at_limits.begin(), at_limits.end());
  }
}

bool are_joined(const vector<string>& cases) {
  return std::none_of(cases.begin(), cases.end(), [](const string& name) { return name.rfind("free-", 0) == 0; });
}

// Replaces powers above the `degrees` of a robot's numbers by lower ones, T_k being at most 1; returns what that changes.
Q economize(std::map<Key, Q>& terms, const Space& space, const vector<int>& degrees) {
  Q changed = 0;
  for (int v = space.n + 1; v <= space.n + space.m; v++) {
    int most = 0;
    for (auto& [key, c] : terms) most = std::max(most, exponent(key, v));
    for (int k = most; k > degrees[size_t(v - space.n - 1)]; k--) {
      vector<long> before{1}, chebyshev{0, 1};
      for (int order = 2; order <= k; order++) {
        vector<long> after(size_t(order) + 1);
        for (size_t i = 0; i < chebyshev.size(); i++) after[i + 1] += 2 * chebyshev[i];
        for (size_t i = 0; i < before.size(); i++) after[i] -= before[i];
        before = chebyshev, chebyshev = after;
      }
      std::map<Key, Q> kept;
      for (auto& [key, c] : terms) {
        if (exponent(key, v) != k) {
          kept[key] += c;
          continue;
        }
        Q scaled = c / Q(Z(1) << (k - 1));
        changed += abs(scaled) * exactly(peak(space.y_part(key)));
        for (int j = 0; j < k; j++)
          if (chebyshev[size_t(j)]) kept[key - power(v, k) + power(v, j)] -= scaled * Q(chebyshev[size_t(j)]);
      }
      terms = kept;
    }
  }
  return changed;
}

// The obligations of a case at every control point of the robots' numbers, each up to its degree if these are given.
void for_all_robots(Named<Obligation>& todo, const Claim& claim, const string& name, Obligation shared, const Model& p,
                    const vector<int>& kept = {}) {
  int n = int(claim.n()), m = int(claim.uncertain.size());
  std::map<Key, Q> terms;
  for (auto& t : p.p) terms[t.key] = exactly(t.c);
  if (!kept.empty()) shared.error += economize(terms, *p.space, kept);
  vector<int> degrees;
  for (int i = 0; i < m; i++) {
    int v = 1 + n + i, degree = 0;
    for (auto& [key, c] : terms) degree = std::max(degree, exponent(key, v));
    degrees.push_back(degree);
    Matrix rows = bernstein_of_powers(degree, degree, -1, 1);
    std::map<Key, Q> changed;
    for (auto& [key, c] : terms)
      for (int j = 0; j <= degree; j++) {
        const Q& weight = rows[size_t(exponent(key, v))][size_t(j)];
        if (weight != 0) changed[key - power(v, exponent(key, v)) + power(v, j)] += c * weight;
      }
    terms = changed;
  }
  double count = 1;
  for (int degree : degrees) count *= degree + 1;
  if (count > 1e5) throw Undecided{"has too many control points: undecided"};
  auto label_of = [&](const vector<int>& at) {
    string label = name;
    for (int i = 0; i < m; i++) label += (i ? "," : "/") + std::to_string(at[size_t(i)]);
    return label;
  };
  vector<int> at(size_t(m), 0);
  std::map<string, size_t> places;
  std::function<void(int)> every = [&](int i) {
    if (i == m) {
      places[label_of(at)] = todo.size();
      todo.push_back({label_of(at), shared});
      return;
    }
    for (at[size_t(i)] = 0; at[size_t(i)] <= degrees[size_t(i)]; at[size_t(i)]++) every(i + 1);
  };
  every(0);
  for (auto& [key, c] : terms) {
    if (c == 0) continue;
    for (int i = 0; i < m; i++) at[size_t(i)] = exponent(key, 1 + n + i);
    todo[places.at(label_of(at))].second.p.push_back({key & ((Key(1) << (8 * (1 + n))) - 1), c});
  }
}

// Old measurements -----------------------------------------------------------------------------------------------------
//
// phi = K e, e = x - x*, of the unsaturated loop: phi' = G + g v with G = K' e + K ((a + b u_k) / D - x*'), g = K b / D,
// v the input beyond u_k. The feedback of tau ago is phi - tau rho e up to
//
//     noise + age (misfit + jumps + reaction (w + 2 late + F+ - F-)) + age^2 / 2 (jerk + reaction speed),
//
// misfit >= |G - g phi - rho e|, jerk >= |G'| + |g'| sup |v|, reaction >= g, late the error without any order.

struct Along {
  Model d;
  vector<Model> a, b, error, gain, gain_rate, rate, bend, row;  // row: rho; rate, bend: x*', x*''
  Q input;
};

struct Bounds {
  Q jerk, reaction, misfit;
};

// D, a and b times the power of two that makes D about one.
Q scale_of(const Model& d) {
  Q center = exactly(d.constant());
  long power = long(mpz_sizeinbase(center.get_den_mpz_t(), 2)) - long(mpz_sizeinbase(center.get_num_mpz_t(), 2));
  if (center == 0) power = 0;
  return power >= 0 ? Q(Z(1) << power) : ratio(1, Z(1) << -power);
}

vector<Model> times(const vector<Model>& models, const Q& q) {
  vector<Model> out;
  for (auto& each : models) out.push_back(each * q);
  return out;
}

Q least_of(const Model& d, const string& place) {
  Q least = d.least();
  require(least > 0, place, "the mass matrix' determinant is not shown to be positive here");
  return least;
}

Bounds delay_bounds(const Claim& claim, const Here& here, const Along& on, const Q& scale, const Q& late, const string& place) {
  Q least = least_of(on.d, place), input = on.input;
  vector<Model> moving, off;  // D x' and D e' at the input u_k
  for (size_t i = 0; i < claim.n(); i++) {
    moving.push_back(on.a[i] + on.b[i] * input);
    off.push_back(moving[i] - on.d * on.rate[i]);
  }
  Model phi = dot(on.gain, on.error), kick = dot(on.gain, on.b), drive = dot(on.gain, moving);
  Q over = std::max(Q(0), Q(abs(input) - claim.limits.first)), largest_u = 0;
  for (auto& u : claim.u) largest_u = std::max(largest_u, Q(abs(u)));
  Q beyond = std::min(Q(claim.limits.second + abs(input)), Q(phi.largest() + late + over)) + claim.disturbance;
  Q strength = claim.limits.second + largest_u;
  auto scaled = [&](Field<Model> f) { return Field<Model>{f.d * scale, times(f.a, scale), times(f.b, scale)}; };
  Field<Model> by_drift = scaled(here.rates(moving)), by_input = scaled(here.rates(on.b));
  Model square = on.d * on.d, turning = dot(on.gain_rate, on.b) * square;
  // D^3 times the rate of (K (a + b u_k)) / D, and of (K b) / D, along a direction
  auto of_drive = [&](const Field<Model>& f) { return (dot(on.gain, f.a) + dot(on.gain, f.b) * input) * on.d - drive * f.d; };
  auto of_kick = [&](const Field<Model>& f) { return dot(on.gain, f.b) * on.d - kick * f.d; };
  Model still = dot(on.gain_rate, off) * square * Q(2) - dot(on.gain, on.bend) * (square * on.d);
  Q cube = least * least * least;
  Q own = (still + of_drive(by_drift)).largest() + beyond * (turning + of_drive(by_input)).largest();
  Q pull = (turning + of_kick(by_drift)).largest() + beyond * of_kick(by_input).largest();
  Model misfit = dot(on.gain_rate, on.error) * on.d + dot(on.gain, off) - kick * phi - dot(on.row, on.error) * on.d;
  return {(own + strength * pull) / cube, kick.largest() / least, misfit.largest() / least};
}

void require_delay(const Claim& claim, const Bounds& bounds, const string& place) {
  string unit = printable(claim.robot.input_unit);
  auto within = [&](const char* name, const Q& value, const Q& claimed) {
    require(value <= claimed, place, string("the feedback's ") + name + " may be " + formatted("%.6g", rounded(value)) + " " +
                                         unit + ", more than claim." + name);
  };
  within("jerk", bounds.jerk, claim.jerk);
  within("reaction", bounds.reaction, claim.reaction);
  require(claim.age * claim.reaction <= 1, place, "the age times claim.reaction must be at most 1");
}

Q lateness(const Claim& claim, const Q& late, const Q& misfit, const Q& jumps) {
  Q spread = claim.limits.second - claim.limits.first, noise = late - claim.age * claim.speed;
  Q first = misfit + jumps + claim.reaction * (claim.disturbance + 2 * late + spread);
  return noise + claim.age * first + claim.age * claim.age / 2 * (claim.jerk + claim.reaction * claim.speed);
}

// The funnel -----------------------------------------------------------------------------------------------------------

struct Interval {
  long knot;
  Q start, end;
  Matrix first, last, bend[2], late;  // late: rho at both ends, linear in between
  vector<int> orders;  // in s and y; about own motions also the stride of the robot's numbers, and their degrees that stay
  vector<string> names;
  std::map<string, Gram> cases;
  vector<Matrix> sides;  // of every ellipsoid to keep out of: the normals of half spaces that hold it, at both ends
};

Space space_of(const Claim& claim, const Interval& piece) {
  return claim.space(piece.orders[0], piece.orders[1], piece.orders.size() > 2 ? piece.orders[2] : 0);
}

struct Shifted {  // a part of c_p - x* and its rate, in s
  vector<int> powers;
  vector<Curve> state, rate;
};

struct Motion {  // on one interval, in s
  vector<Curve> state, rate, bend, gain, gain_rate;
  vector<Shifted> shifts;
  vector<vector<Curve>> axes, axes_rate;
  Q input, duration;
};

Motion motion(const Claim& claim, const Interval& piece) {
  size_t n = claim.n(), k = size_t(piece.knot);
  Q half = (piece.end - piece.start) / 2, pace = 1 / (claim.dt * half);  // ds/dt
  Curve fraction{(piece.start + piece.end) / 2, half};
  auto rates = [&](const vector<Curve>& curves) {
    vector<Curve> out;
    for (auto& curve : curves) out.push_back(slope(curve) * pace);
    return out;
  };
  Motion out;
  auto cubic = [&](const Matrix& x, const vector<Matrix>& slopes, size_t i) {
    const Q &a = x[k][i], &b = x[k + 1][i];
    Q va = claim.dt * slopes[k][0][i], vb = claim.dt * slopes[k][1][i];
    return at(Curve{a, va, 3 * (b - a) - 2 * va - vb, 2 * (a - b) + va + vb}, fraction);
  };
  for (auto& shift : claim.shifts) {
    Shifted part{shift.powers, {}, {}};
    for (size_t i = 0; i < n; i++) part.state.push_back(cubic(shift.x, shift.rates, i));
    part.rate = rates(part.state);
    out.shifts.push_back(part);
  }
  for (size_t i = 0; i < n; i++) {
    out.state.push_back(cubic(claim.x, claim.rates, i));
    out.gain.push_back(at(Curve{claim.k[k][i], claim.k[k + 1][i] - claim.k[k][i]}, fraction));
    vector<Curve> row;
    for (size_t j = 0; j < n; j++) {
      Curve straight{(piece.first[i][j] + piece.last[i][j]) / 2, (piece.last[i][j] - piece.first[i][j]) / 2};
      row.push_back(straight + Curve{1, 0, -1} * Curve{piece.bend[0][i][j], piece.bend[1][i][j]});
    }
    out.axes.push_back(row);
    out.axes_rate.push_back(rates(row));
  }
  out.rate = rates(out.state), out.bend = rates(out.rate), out.gain_rate = rates(out.gain);
  out.input = claim.u[k], out.duration = 2 / pace;
  return out;
}

// row (c_p - x*), a polynomial in s and the robot's numbers, times `sign`; or the row times its rate.
Model along_shifts(const Space& space, const Motion& on, const vector<Curve>& row, const Q& sign = 1, bool rate = false) {
  Model total(space);
  for (auto& part : on.shifts) total = total + model(space, dot(row, rate ? part.rate : part.state) * sign, space.robot(part.powers));
  return total;
}

vector<Curve> unit_row(size_t n, size_t i) {
  vector<Curve> row(n, Curve{0});
  row[i] = Curve{1};
  return row;
}

// Adds c_p - x* to values about x*.
vector<Model> with_shifts(const Space& space, const Motion& on, vector<Model> values, bool rate = false) {
  for (size_t i = 0; i < values.size(); i++) values[i] = values[i] + along_shifts(space, on, unit_row(values.size(), i), 1, rate);
  return values;
}

// Whether row x* + c_p's part, plus a curve, is positive for all robots, and its square above another curve.
bool clears(const Claim& claim, const Motion& on, const vector<Curve>& row, const Curve& curve, const Curve& square) {
  size_t m = claim.uncertain.size();
  Exact left, most;
  auto add = [&](Exact& to, const Curve& c, const vector<int>& powers) {
    for (size_t i = 0; i < c.size(); i++) {
      vector<int> e{int(i)};
      e.insert(e.end(), powers.begin(), powers.end());
      to[e] += c[i];
    }
  };
  vector<int> none(m, 0);
  add(left, curve + dot(row, on.state), none);
  for (auto& part : on.shifts) add(left, dot(row, part.state), part.powers);
  add(most, square * Q(-1), none);
  vector<std::pair<Q, Q>> box(1 + m, {Q(-1), Q(1)});
  return is_positive(left, box) && is_positive(left * left + most, box);
}

// |x_i| <= bound in the ellipsoids.
void require_bounds(const Claim& claim, const Motion& on, const string& place) {
  for (size_t i = 0; i < claim.n(); i++) {
    if (!claim.bounds[i]) continue;
    for (int sign : {1, -1}) {
      vector<Curve> row = unit_row(claim.n(), i);
      row[i] = row[i] * Q(sign);
      bool inside = clears(claim, on, row, Curve{*claim.bounds[i]}, dot(on.axes[i], on.axes[i]));
      require(inside, place, "the limit |" + printable(claim.robot.states[i]) + "| <= " +
                                 formatted("%.6g", rounded(*claim.bounds[i])) + " " + printable(claim.robot.units[i]) + " is not kept");
    }
  }
}

// Every set lies in a half space w'(x - c) > offset, with w linear in s, which the ellipsoids do not meet.
void require_kept_out(const Claim& claim, const Interval& piece, const Motion& on, const string& place) {
  size_t n = claim.n(), ellipsoid = 0;
  for (size_t j = 0; j < claim.keep_out.size(); j++) {
    const KeptOut& each = claim.keep_out[j];
    Matrix ends = each.half ? Matrix{each.normal, each.normal} : piece.sides[ellipsoid++];
    Curve left{each.half ? each.offset : Q(-std::max(each.support(ends[0]), each.support(ends[1])))};
    vector<Curve> w, away, turned(n, Curve{0});
    for (size_t i = 0; i < n; i++) {
      w.push_back({(ends[0][i] + ends[1][i]) / 2, (ends[1][i] - ends[0][i]) / 2});
      away.push_back(w[i] * Q(-1));
      left = left + w[i] * Curve{each.half ? Q(0) : each.center[i]};
    }
    for (size_t column = 0; column < n; column++)
      for (size_t i = 0; i < n; i++) turned[column] = turned[column] + w[i] * on.axes[i][column];
    bool outside = clears(claim, on, away, left, dot(turned, turned));
    require(outside, place, "the set claim.keep_out[" + std::to_string(j) + "] is not kept out of");
  }
}

vector<Model> errors_of(const Space& space, const vector<vector<Curve>>& axes) {
  vector<Model> out;
  for (auto& row : axes) out.push_back(form(space, row));
  return out;
}

vector<Model> states_of(const Space& space, const vector<Curve>& state, const vector<Model>& error) {
  vector<Model> out;
  for (size_t i = 0; i < state.size(); i++) out.push_back((model(space, state[i]) + error[i]).tidy());
  return out;
}

vector<Model> tidied(const vector<Model>& models) {
  vector<Model> out;
  for (auto& each : models) out.push_back(each.tidy());
  return out;
}

// x* + (b / D) J, or c_p + (b / D) J, in the ellipsoid for |J| <= push: (D det L)^2 > |push adj(L) b|^2.
void require_push(const Claim& claim, const Interval& piece, const Motion& on, const string& place) {
  Space space = space_of(claim, piece);
  vector<Model> x = tidied(with_shifts(space, on, models(space, on.state)));
  Here here(claim, space, x, waves_near(claim.robot.waves, x, place), place);
  auto [adjugate, determinant] = cofactors(on.axes, Curve{1});
  Model room = here.f.d * model(space, determinant), needed(space);
  for (auto& row : adjugate) {
    Model moved = dot(models(space, row), here.f.b);
    needed = needed + moved * moved;
  }
  Model clearance = room * room - needed * Q(claim.push * claim.push);
  Exact terms;
  size_t m = claim.uncertain.size(), n = claim.n();
  terms[vector<int>(1 + m, 0)] = -exactly(clearance.r + clearance.d);
  for (auto& t : clearance.p) {
    vector<int> e{exponent(t.key, 0)};
    for (size_t i = 0; i < m; i++) e.push_back(exponent(t.key, int(1 + n + i)));
    terms[e] += exactly(t.c);
  }
  bool inside = is_positive(terms, vector<std::pair<Q, Q>>(1 + m, {Q(-1), Q(1)}));
  require(inside, place, "an impulse of " + formatted("%.6g", rounded(claim.push)) + " " + printable(claim.robot.input_unit) +
                             " s may leave the funnel");
}

// How the feedback's rate may jump at the knot where an interval begins.
void require_jump(const Claim& claim, const Interval& piece, const string& place) {
  size_t n = claim.n(), k = size_t(piece.knot);
  if (piece.start != 0 || k == 0) return;
  Space space = space_of(claim, piece);
  vector<vector<Curve>> axes(n);
  vector<Curve> center;
  Motion here_on;
  for (auto& shift : claim.shifts) {
    Shifted part{shift.powers, {}, {}};
    for (size_t i = 0; i < n; i++) part.state.push_back({shift.x[k][i]});
    here_on.shifts.push_back(part);
  }
  for (size_t i = 0; i < n; i++) {
    for (auto& c : piece.first[i]) axes[i].push_back({c});
    center.push_back({claim.x[k][i]});
  }
  vector<Model> error = tidied(with_shifts(space, here_on, errors_of(space, axes))), x = states_of(space, center, error);
  Here here(claim, space, x, waves_near(claim.robot.waves, x, place), place);
  Q scale = scale_of(here.f.d), step = claim.u[k] - claim.u[k - 1];
  Model d = here.f.d * scale, moved(space), turned(space);
  for (size_t i = 0; i < n; i++) {
    Q rate = claim.rates[k][0][i] - claim.rates[k - 1][1][i];
    Q bent = (claim.k[k + 1][i] - 2 * claim.k[k][i] + claim.k[k - 1][i]) / claim.dt;
    moved = moved + (here.f.b[i] * scale * step - d * rate) * claim.k[k][i];
    turned = turned + error[i] * bent;
  }
  Q jump = moved.largest() / least_of(d, place) + turned.largest() + claim.reaction * abs(step);
  require(jump <= claim.jumps[k], place, "the feedback's rate may jump by " + formatted("%.6g", rounded(jump)) + " " +
                                             printable(claim.robot.input_unit) + "/s, by more than claim.jumps[" + std::to_string(k) + "]");
}

void require_speed(const Claim& claim, const Q& fastest, const string& place) {
  require(fastest <= claim.speed, place, "the feedback may change by " + formatted("%.6g", rounded(fastest)) + " " +
                                             printable(claim.robot.input_unit) + "/s, by more than claim.speed");
}

// A bound of |K e'|, `rate` being D e' without the input's part.
Q speed_of(const Claim& claim, const Field<Model>& f, const vector<Model>& gain, const vector<Model>& rate, const string& place) {
  Q least = least_of(f.d, place);
  return (dot(gain, rate).largest() + dot(gain, f.b).largest() * (claim.limits.second + claim.disturbance)) / least;
}

// c, near 2 / (D det L) at the middle; the theorem needs c > 0.
Q positive_scale(const Q& d, const Q& determinant, const string& place) {
  require(d > 0 && determinant > 0, place, "the mass matrix' determinant is not shown to be positive here");
  bool exact;
  Q scale(nearest(2 / (d * determinant), exact, 30), 1 << 30);
  scale.canonicalize();
  require(scale > 0, place, "proves no decrease: the robot's determinant is too large");
  return scale;
}

// What is to be shown on an interval, by case.
Named<Obligation> funnel_obligations(const Claim& claim, const Interval& piece, const Motion& on, const string& place) {
  Space space = space_of(claim, piece), wide = space;
  wide.y_order++;
  size_t n = claim.n();
  auto [adjugate, determinant] = cofactors(on.axes, Curve{1});
  require(is_positive(determinant), place, "an ellipsoid is degenerate: det L must be > 0");
  vector<Model> error = with_shifts(space, on, errors_of(space, on.axes)), x = states_of(space, on.state, error);
  Here here(claim, space, x, waves_near(claim.robot.waves, x, place), place);
  const Field<Model>& f = here.f;
  vector<Model> gain = models(space, on.gain);
  if (claim.age != 0) {
    vector<Model> rate;
    for (size_t i = 0; i < n; i++) rate.push_back(f.a[i] - f.d * model(space, on.rate[i]));
    Model turning = dot(models(space, on.gain_rate), error);
    require_speed(claim, turning.largest() + speed_of(claim, f, gain, rate, place), place);
  }
  Q scale = positive_scale(exactly(f.d.constant()), determinant[0], place);
  // c y' adj(L), and a - D (x*' + L' y)
  vector<Model> push, relative;
  for (auto& column : transposed(adjugate)) push.push_back(form(wide, column) * scale);
  for (size_t i = 0; i < n; i++) {
    Model own = along_shifts(space, on, unit_row(n, i), 1, true);
    Model drag = (model(space, on.rate[i]) + own + form(space, on.axes_rate[i])).tidy();
    relative.push_back((f.a[i] - f.d * drag).in(wide));
  }
  vector<Model> b;
  for (auto& each : f.b) b.push_back(each.in(wide));
  Model free = dot(push, relative), forced = dot(push, b);

  auto by_axes = [&](const vector<Curve>& row) {  // row L
    vector<Curve> out;
    for (auto& column : transposed(on.axes)) out.push_back(dot(row, column));
    return out;
  };
  vector<Curve> asked;  // the coefficients of -K L y
  for (auto& c : by_axes(on.gain)) asked.push_back(c * Q(-1));
  vector<Curve> asked_then;
  Model own = along_shifts(wide, on, on.gain, -1), own_then(wide);  // of the feedback, what is the robot's
  Q late = claim.error_on(piece.knot);
  if (claim.first_order) {
    vector<Curve> row, older;
    for (size_t i = 0; i < n; i++) {
      row.push_back({(piece.late[0][i] + piece.late[1][i]) / 2, (piece.late[1][i] - piece.late[0][i]) / 2});
      older.push_back(row[i] * claim.age - on.gain[i]);
    }
    Q unit = scale_of(f.d);
    Along along{f.d * unit, times(f.a, unit), times(f.b, unit), tidied(error), tidied(gain), tidied(models(space, on.gain_rate)),
                tidied(models(space, on.rate)), tidied(models(space, on.bend)), tidied(models(space, row)), on.input};
    Bounds bounds = delay_bounds(claim, here, along, unit, late, place);
    require_delay(claim, bounds, place);
    Q jumps = 0;  // between the oldest measurement and the interval's present
    if (piece.start * claim.dt < claim.age)
      for (long j = claim.oldest(piece.knot) + 1; j <= piece.knot; j++) jumps += claim.jumps[size_t(j)];
    late = lateness(claim, late, bounds.misfit, jumps);
    asked_then = by_axes(older);
    own_then = along_shifts(wide, on, older);
  }

  Named<Case> cases;
  bool joined = are_joined(piece.names);
  add_cases(cases, claim, late, on.input, dot(asked, asked), -1, 1, false, joined, own.largest());
  if (claim.first_order) add_cases(cases, claim, late, on.input, dot(asked_then, asked_then), -1, 1, true, joined, own_then.largest());
  Named<Obligation> todo;
  vector<int> kept;
  if (!claim.shifts.empty()) kept.assign(piece.orders.begin() + 3, piece.orders.end());
  for (auto& [name, one] : cases) {
    const vector<Curve>& linear = one.late ? asked_then : asked;
    Model input = model(wide, one.input);
    if (!one.saturated) input = input + form(wide, linear) + (one.late ? own_then : own);
    Model q = (free + forced * input) * Q(-1);
    Obligation shared{{}, exactly(q.r + q.d), 0, {}, -1, 1};
    for (size_t i = 0; i < one.where_constant.size(); i++) {
      vector<std::pair<Key, Q>> g{{0, one.where_constant[i][0]}};
      for (size_t j = 0; j < n; j++)
        for (size_t e = 0; e < linear[j].size(); e++) 
          if (linear[j][e] != 0) g.push_back({power(0, int(e)) + power(1 + int(j)), linear[j][e] * one.where_sign[i]});
      shared.where.push_back(g);
    }
    for_all_robots(todo, claim, name, shared, q, kept);
  }
  return todo;
}

// The goal -------------------------------------------------------------------------------------------------------------

struct Shell {
  Q start, end;
  vector<string> names;
  std::map<string, Gram> cases;
};

struct Goal {
  Matrix axes;
  int order;
  Q weight, rest;
  vector<Shell> shells;
  Row late;
  vector<Matrix> sides;
};

struct GoalField {  // 2 y' adj(L) a / l and 2 y' adj(L) b / l times a constant > 0, after y = l z
  Space space, wide;
  std::unique_ptr<Model> free, forced;
  Row asked, asked_then;  // coefficients of the feedback's input / l
  Q late;
};

// Fills `out`, whose spaces the models point to.
void goal_field(const Claim& claim, const Goal& goal, const string& place, GoalField& out) {
  size_t n = claim.n();
  out.space = claim.space(MAX_ORDER, goal.order), out.wide = out.space;
  out.wide.y_order++;
  const Space& space = out.space;
  auto [adjugate, determinant] = cofactors(goal.axes, Q(1));
  require(determinant > 0, place, "the ellipsoid is degenerate: det L must be > 0");
  auto constants = [](const Row& row) {
    vector<Curve> out;
    for (auto& q : row) out.push_back({q});
    return out;
  };
  vector<Model> error, x;
  for (size_t i = 0; i < n; i++) {
    error.push_back(form(space, constants(goal.axes[i]), 1));
    x.push_back(model(space, claim.x_goal[i]) + error[i]);
  }
  Here here(claim, space, x, waves_at_goal(claim, place), place);
  const Field<Model>& f = here.f;
  vector<Model> gain = models(space, constants(claim.k_goal));
  if (claim.age != 0) require_speed(claim, speed_of(claim, f, gain, f.a, place), place);
  for (auto& each : f.a)
    for (auto& t : each.p)
      require((t.key & ((Key(1) << (8 * (1 + n))) - 1)) != 0, place, "the goal is no equilibrium");
  Q scale = positive_scale(exactly(f.d.constant()), determinant, place);
  vector<Model> push, a, b;
  for (auto& column : transposed(adjugate)) push.push_back(form(out.wide, constants(column)) * scale);
  for (size_t i = 0; i < n; i++) a.push_back(f.a[i].in(out.wide)), b.push_back(f.b[i].in(out.wide));
  out.free = std::make_unique<Model>(dot(push, a));
  out.forced = std::make_unique<Model>(dot(push, b));
  auto by_axes = [&](const Row& row) {
    Row product;
    for (auto& column : transposed(goal.axes)) product.push_back(dot(row, column));
    return product;
  };
  for (auto& c : by_axes(claim.k_goal)) out.asked.push_back(-c);
  out.late = claim.error({claim.k_goal});
  if (!claim.first_order) return;
  vector<Model> nothing(n, Model(space));
  Q unit = scale_of(f.d);
  Along along{f.d * unit, times(f.a, unit), times(f.b, unit), error, gain, nothing, nothing, nothing,
              models(space, constants(goal.late)), 0};
  Bounds bounds = delay_bounds(claim, here, along, unit, out.late, place);
  require_delay(claim, bounds, place);
  out.late = lateness(claim, out.late, bounds.misfit, 0);
  Row moved = by_axes(goal.late);
  for (size_t j = 0; j < n; j++) out.asked_then.push_back(out.asked[j] + claim.age * moved[j]);
}

// On l in [low, high]: q / l where the input is saturated or the goal is moved, else q / l^2.
Named<Obligation> goal_obligations(const Claim& claim, const GoalField& field, const Q& low, const Q& high, bool joined) {
  const Space& wide = field.wide;
  size_t n = claim.n();
  Named<Case> cases;
  add_cases(cases, claim, field.late, 0, Curve{0, 0, dot(field.asked, field.asked)}, low, high, false, joined);
  if (claim.first_order)
    add_cases(cases, claim, field.late, 0, Curve{0, 0, dot(field.asked_then, field.asked_then)}, low, high, true, joined);
  Named<Obligation> todo;
  for (auto& [name, one] : cases) {
    const Row& asked = one.late ? field.asked_then : field.asked;
    vector<Curve> linear;
    for (auto& c : asked) linear.push_back({c});
    Obligation shared{{}, 0, 0, {}, low, high};
    for (size_t i = 0; i < one.where_constant.size(); i++) {
      vector<std::pair<Key, Q>> g{{0, one.where_constant[i][0]}};
      for (size_t j = 0; j < n; j++) g.push_back({power(0) + power(1 + int(j)), asked[j] * one.where_sign[i]});
      shared.where.push_back(g);
    }
    Model q(wide);
    if (one.saturated || claim.moves_the_goal()) {
      Model input = model(wide, one.input);
      if (!one.saturated) input = input + form(wide, linear, 1);
      q = *field.free + *field.forced * input;
      shared.error = exactly(q.r) * high + exactly(q.d);
    } else {
      Model lowered = *field.free;
      for (auto& t : lowered.p) t.key -= power(0);  // all of them vanish with l: the goal is an equilibrium
      Model held = *field.forced * form(wide, linear);
      shared.error = exactly(field.free->r + held.r + held.d), shared.drift = exactly(field.free->d);
      lowered.r = lowered.d = 0;
      q = lowered + held;
    }
    for_all_robots(todo, claim, name, shared, q * Q(-1));
  }
  return todo;
}

// The Bernstein control points of c_p(t_N) over the robots: c_p(t_N) is a mean of them.
vector<Row> last_centers(const Claim& claim) {
  size_t m = claim.uncertain.size(), n = claim.n();
  vector<int> degrees(claim.shifts.empty() ? 0 : m, 0), at(degrees.size(), 0);
  for (auto& shift : claim.shifts)
    for (size_t i = 0; i < m; i++) degrees[i] = std::max(degrees[i], shift.powers[i]);
  vector<Row> centers;
  std::function<void(size_t)> every = [&](size_t i) {
    if (i < at.size()) {
      for (at[i] = 0; at[i] <= degrees[i]; at[i]++) every(i + 1);
      return;
    }
    Row center = claim.x.back();
    for (auto& shift : claim.shifts) {
      Q weight = 1;
      for (size_t j = 0; j < m; j++)
        weight *= bernstein_of_powers(degrees[j], degrees[j], -1, 1)[size_t(shift.powers[j])][size_t(at[j])];
      for (size_t j = 0; j < n; j++) center[j] += weight * shift.x.back()[j];
    }
    centers.push_back(center);
  };
  every(0);
  return centers;
}

// E(t_N) in G: |adj(L_g) (c - x_g + L_N y)| < det L_g for |y| <= 1, by the S-lemma with the file's weight; where that
// holds for some centers c it does for their means.
void require_arrival(const Claim& claim, const Matrix& outlet, const Goal& goal, const Row& center, const string& place) {
  size_t n = claim.n();
  auto [adjugate, determinant] = cofactors(goal.axes, Q(1));
  Matrix columns = transposed(outlet);
  columns.emplace_back();
  for (size_t i = 0; i < n; i++) columns.back().push_back(center[i] - claim.x_goal[i]);
  Matrix moved, form(n + 1, Row(n + 1));
  for (auto& column : columns) {
    moved.emplace_back();
    for (auto& row : adjugate) moved.back().push_back(dot(row, column));
  }
  for (size_t i = 0; i <= n; i++)
    for (size_t j = 0; j <= n; j++) form[i][j] = -dot(moved[i], moved[j]);
  for (size_t i = 0; i < n; i++) form[i][i] += goal.weight;
  form[n][n] += determinant * determinant - goal.weight;
  require(is_positive_definite(form), place, "the funnel's outlet is not shown to lie in the goal region");
}

// The catch ------------------------------------------------------------------------------------------------------------

// All k but zero of some functions.
vector<Joints> waves_of(const Robot& robot, const vector<vector<Function>>& functions) {
  std::set<Joints> all;
  for (auto& row : functions)
    for (auto& f : row)
      for (auto& term : f) all.insert(robot.wave(std::get<0>(term)));
  all.erase(Joints(robot.joints(), 0));
  return {all.begin(), all.end()};
}

std::map<Joints, std::pair<Model, Model>> turned(const vector<Joints>& waves, const vector<Model>& x, const string& place) {
  std::map<Joints, std::pair<Model, Model>> out;
  for (auto& [k, value] : waves_near(waves, x, place)) out.emplace(k, sine_and_cosine(angle_of(k, x), value, place));
  return out;
}

// D and D x+ of the states x, D the determinant of the mass matrix after the reset.
std::pair<Model, vector<Model>> after_reset(const Claim& claim, const vector<Model>& x, const string& place) {
  const Space& space = *x[0].space;
  const Catch& reset = *claim.caught;
  const Robot& robot = claim.robot;
  size_t n = robot.joints();
  Model one = model(space, Q(1));
  vector<Model> q(x.begin(), x.begin() + long(n)), v(x.begin() + long(n), x.end()), after;
  for (size_t i = 0; i < n; i++) {
    Model at = model(space, Q(PI * reset.turns[i]));
    at.d += up(PI_ERROR * std::abs(reset.turns[i]));
    for (size_t j = 0; j < n; j++) at = at + q[j] * Q(reset.positions[i][j]);
    after.push_back(at);
  }
  std::map<string, Q> known = claim.exact(), known_after = reset.exact;
  std::map<string, Model> open = claim.between(space), open_after;
  for (auto& [name, other] : reset.renamed) {
    if (known.count(other)) known_after[name] = known.at(other);
    else open_after.emplace(name, open.at(other));
  }
  auto before = turned(waves_of(robot, reset.momentum), q, place), then = turned(waves_of(robot, robot.mass), after, place);
  vector<Model> momenta;
  for (auto& row : reset.momentum) {
    momenta.emplace_back(space);
    for (size_t j = 0; j < n; j++) momenta.back() = momenta.back() + evaluated(robot, row[j], known, open, q, before, one) * v[j];
  }
  auto mass = symmetric<Model>(robot.mass, [&](const Function& f) { return evaluated(robot, f, known_after, open_after, after, then, one); });
  auto [adjugate, determinant] = cofactors(mass, one);
  vector<Model> out;
  for (auto& at : after) out.push_back(determinant * at);
  for (auto& row : adjugate) out.push_back(dot(row, momenta));
  return {determinant, out};
}

// |adj(L_c) D (x+ - c)| < D det L_c at all states c_p(t_N) + l L_N z, l in [0, 1], |z| = 1; without a reset x+ = x, D = 1.
Named<Obligation> catch_obligations(const Claim& claim, const Matrix& outlet, int order, const string& place) {
  Space space = claim.space(MAX_ORDER, order);
  vector<Model> x;
  for (size_t i = 0; i < claim.n(); i++) {
    vector<Curve> row;
    for (auto& q : outlet[i]) row.push_back({q});
    Model at = model(space, claim.x.back()[i]) + form(space, row, 1);
    for (auto& shift : claim.shifts) at = at + model(space, std::map<Key, Q>{{space.robot(shift.powers), shift.x.back()[i]}});
    x.push_back(at.tidy());
  }
  const Catch& set = *claim.caught;
  auto [adjugate, determinant] = cofactors(set.axes, Q(1));
  require(determinant > 0, place, "the catch set is degenerate: det L must be > 0");
  auto [factor, landed] = set.resets ? after_reset(claim, x, place) : std::make_pair(model(space, Q(1)), x);
  Q scale = positive_scale(exactly(factor.constant()), determinant, place) / 2;
  vector<Model> offset;
  for (size_t i = 0; i < claim.n(); i++) offset.push_back((landed[i] - factor * set.center[i]) * scale);
  Model room = factor * Q(determinant * scale), q = room * room;
  for (auto& row : adjugate) {
    Model apart(space);
    for (size_t i = 0; i < claim.n(); i++) apart = apart + offset[i] * row[i];
    q = q - apart * apart;
  }
  Named<Obligation> todo;
  for_all_robots(todo, claim, "caught", Obligation{{}, exactly(q.r + q.d), 0, {}, 0, 1}, q);
  return todo;
}

// The file's parts -----------------------------------------------------------------------------------------------------

Function read_function(const Node& node, const vector<bool>& hinge) {
  Function out;
  auto terms = node.items();
  node.require(terms.size() <= MOST_TERMS_OF_ROBOT, "must have at most " + std::to_string(MOST_TERMS_OF_ROBOT) + " terms");
  for (auto& term : terms) {
    term.exactly({"joints", "powers", "cos", "sin"});
    Joints joints;
    size_t i = 0;
    for (auto& each : term.at("joints").items(long(hinge.size()))) joints.push_back(int(each.integer(hinge[i++] ? -HIGHEST : 0, HIGHEST)));
    Powers powers;
    for (auto& [name, value] : term.at("powers").named()) powers.push_back({name, int(value.integer(1, HIGHEST))});
    std::sort(powers.begin(), powers.end());
    out.push_back({joints, powers, term.at("cos").number(), term.at("sin").number()});
  }
  return out;
}

Robot read_robot(const Node& node) {
  node.keys({"name", "states", "units", "input_unit", "joints", "mass", "potential", "damping", "motor"});
  node.digests();
  Robot robot;
  vector<string> kinds = node.at("joints").names(-1, 1);
  for (auto& kind : kinds) {
    node.at("joints").require(kind == "hinge" || kind == "slide", "must be hinge or slide");
    robot.hinge.push_back(kind == "hinge");
  }
  long count = long(kinds.size());
  node.at("joints").require(count <= MOST_JOINTS, "has " + std::to_string(count) + " entries, must have at most " + std::to_string(MOST_JOINTS));
  robot.name = node.at("name").name(), robot.input_unit = node.at("input_unit").name();
  robot.states = node.at("states").names(2 * count), robot.units = node.at("units").names(2 * count);
  long i = 0;
  for (auto& row : node.at("mass").items(count)) {
    robot.mass.emplace_back();
    for (auto& entry : row.items(++i)) robot.mass.back().push_back(read_function(entry, robot.hinge));
  }
  robot.potential = read_function(node.at("potential"), robot.hinge);
  auto constants = [&](const Node& each) {
    vector<Function> out;
    for (auto& entry : each.items(count)) out.push_back(read_function(entry, robot.hinge));
    for (auto& f : out)
      for (auto& term : f)
        for (int k : std::get<0>(term)) each.require(k == 0, "must not move");
    return out;
  };
  robot.damping = constants(node.at("damping")), robot.motor = constants(node.at("motor"));
  robot.derive();
  return robot;
}

// The two robots that files of version 1 name, by theta = 0 where the pendulum hangs and the cart-pole's pole stands.
Robot pendulum() {
  Robot robot;
  robot.name = "pendulum", robot.input_unit = "N m", robot.hinge = {true};
  robot.states = {"theta", "theta_dot"}, robot.units = {"rad", "rad/s"};
  robot.mass = {{{{{0}, {{"l", 2}, {"m", 1}}, 1, 0}}}};
  robot.potential = {{{1}, {{"g", 1}, {"l", 1}, {"m", 1}}, -1, 0}};
  robot.damping = {{{{0}, {{"b", 1}}, 1, 0}}}, robot.motor = {{{{0}, {}, 1, 0}}};
  robot.derive();
  return robot;
}
Robot cartpole() {
  Robot robot;
  robot.name = "cartpole", robot.input_unit = "N", robot.hinge = {false, true};
  robot.states = {"cart", "theta", "cart_dot", "theta_dot"}, robot.units = {"m", "rad", "m/s", "rad/s"};
  Joints still{0, 0}, turned{0, 1};
  robot.mass = {{{{still, {{"Mc", 1}}, 1, 0}, {still, {{"Mp", 1}}, 1, 0}}},
                {{{turned, {{"Mp", 1}, {"lp", 1}}, -1, 0}},
                 {{still, {{"inertia_about_com", 1}}, 1, 0}, {still, {{"Mp", 1}, {"lp", 2}}, 1, 0}}}};
  robot.potential = {{turned, {{"Mp", 1}, {"g", 1}, {"lp", 1}}, 1, 0}};
  robot.damping = {{{still, {{"Beq", 1}}, 1, 0}}, {{still, {{"Bp", 1}}, 1, 0}}};
  robot.motor = {{{still, {}, 1, 0}}, {}};
  robot.derive();
  return robot;
}

const vector<string> LOOP{"state_limits", "dt", "x", "rates", "u", "K", "start"}, AT_GOAL{"x_goal", "K_goal"};

void read_loop(const Node& node, Claim& claim) {
  long n = long(claim.robot.states.size());
  for (auto& limit : node.at("state_limits").items(n))
    claim.bounds.push_back(limit.is(Value::NUL) ? std::optional<Q>() : limit.number());
  claim.dt = node.at("dt").number();
  node.at("dt").require(claim.dt > 0, "must be > 0");
  long knots = long(node.at("x").items(-1, 2).size());
  claim.x = node.at("x").matrix(knots, n);
  for (auto& pair : node.at("rates").items(knots - 1)) claim.rates.push_back(pair.matrix(2, n));
  claim.u = node.at("u").row(knots - 1);
  claim.k = node.at("K").matrix(knots, n);
  if (!claim.caught) claim.x_goal = node.at("x_goal").row(n), claim.k_goal = node.at("K_goal").row(n);
  auto start = node.at("start").items(2);
  claim.first_knot = start[0].integer(0, knots - 1), claim.start = start[1].number();
}

Claim read_claim_1(const Node& node) {
  vector<string> names = LOOP;
  names.insert(names.end(), AT_GOAL.begin(), AT_GOAL.end());
  names.insert(names.begin(), {"plant", "parameters"});
  node.keys(names);
  node.digests();
  Node plant = node.at("plant"), given = node.at("parameters");
  plant.require(plant.is(Value::TEXT) && (plant.value->text == "pendulum" || plant.value->text == "cartpole"),
                "must be one of pendulum, cartpole");
  bool cart = plant.value->text == "cartpole";
  vector<string> expected{"m", "l", "b", "g", "torque_limit"};
  if (cart) expected = {"Mc", "Mp", "lp", "inertia_about_com", "Beq", "Bp", "g", "force_limit"};
  bool holds = given.is(Value::OBJECT) && given.value->keys.size() == expected.size();
  for (auto& name : expected) holds = holds && given.value->find(name);
  given.require(holds, "must be the plant's");
  Claim claim;
  claim.robot = cart ? cartpole() : pendulum();
  // Their det M, m l^2 and (Mc + Mp sin^2) (I + Mp lp^2) + .. >= (Mc + Mp) I + Mc Mp lp^2, are > 0 with these signs.
  for (auto& name : expected) {
    Q value = given.at(name).number();
    bool damper = name == "b" || name == "Beq" || name == "Bp";
    given.at(name).require(damper ? value >= 0 : value > 0, damper ? "must be >= 0" : "must be > 0");
    if (name == expected.back()) claim.limits = {value, value};
    else claim.parameters.push_back({name, {value, value}});
  }
  claim.noise.resize(claim.robot.states.size());
  read_loop(node, claim);
  return claim;
}

KeptOut read_set(const Node& node, long n) {
  KeptOut out;
  out.half = node.has("normal");
  node.exactly(out.half ? vector<string>{"normal", "offset"} : vector<string>{"center", "semi_axes"});
  if (out.half) {
    out.normal = node.at("normal").row(n), out.offset = node.at("offset").number();
    return out;
  }
  out.center = node.at("center").row(n);
  for (auto& each : node.at("semi_axes").items(n)) {
    out.semi_axes.push_back(each.is(Value::NUL) ? std::optional<Q>() : each.number());
    each.require(!out.semi_axes.back() || *out.semi_axes.back() > 0, "must be > 0");
  }
  return out;
}

// Of every ellipsoid to keep out of, its side at each of the ends.
vector<Matrix> read_sides(const Node& node, const Claim& claim, long ends) {
  vector<Matrix> sides;
  auto nodes = node.items(long(claim.ellipsoids()));
  for (auto& each : claim.keep_out) {
    if (each.half) continue;
    const Node& here = nodes[sides.size()];
    sides.push_back(here.matrix(ends, long(claim.n())));
    bool flat = true;
    for (auto& row : sides.back())
      for (size_t i = 0; i < row.size(); i++) flat = flat && (each.semi_axes[i] || row[i] == 0);
    here.require(flat, "must be zero where the ellipsoid has no end");
  }
  return sides;
}

vector<Shift> read_shifts(const Node& node, const Claim& claim, long knots) {
  vector<Shift> shifts;
  long n = long(claim.robot.states.size());
  std::set<vector<int>> known;
  for (auto& each : node.items(-1, 1)) {
    each.keys({"powers", "x", "rates"});
    each.digests();
    Shift shift;
    std::map<string, int> by_name;
    for (auto& [name, value] : each.at("powers").named()) by_name[name] = int(value.integer(1, HIGHEST_SHIFT));
    bool holds = !by_name.empty();
    for (auto& [name, e] : by_name) holds = holds && std::count(claim.uncertain.begin(), claim.uncertain.end(), name);
    each.at("powers").require(holds, "must be of " + joined(claim.uncertain));
    for (auto& name : claim.uncertain) shift.powers.push_back(by_name.count(name) ? by_name[name] : 0);
    shift.x = each.at("x").matrix(knots, n);
    bool still = std::all_of(shift.x[0].begin(), shift.x[0].end(), [](const Q& q) { return q == 0; });
    each.at("x").items()[0].require(still, "must be zero: all robots begin about x*(0)");
    for (auto& pair : each.at("rates").items(knots - 1)) shift.rates.push_back(pair.matrix(2, n));
    known.insert(shift.powers);
    shifts.push_back(shift);
  }
  node.require(shifts.size() <= MOST_SHIFTS, "has " + std::to_string(shifts.size()) + " entries, must have at most " + std::to_string(MOST_SHIFTS));
  node.require(known.size() == shifts.size(), "has the same powers twice");
  return shifts;
}

Catch read_catch(const Node& node, const Claim& claim) {
  long n = long(claim.robot.states.size()), joints = long(claim.robot.joints());
  Catch set;
  set.resets = node.has("reset");
  node.keys(set.resets ? vector<string>{"center", "axes", "reset"} : vector<string>{"center", "axes"});
  node.digests();
  set.center = node.at("center").row(n), set.axes = node.at("axes").matrix(n, n);
  if (!set.resets) return set;
  Node reset = node.at("reset");
  for (bool hinge : claim.robot.hinge) reset.require(hinge, "needs a robot whose joints are all hinges");
  reset.keys({"positions", "turns", "numbers", "momentum"});
  reset.digests();
  auto integers = [&](const Node& each) {
    Joints out;
    for (auto& k : each.items(joints)) out.push_back(int(k.integer(-HIGHEST, HIGHEST)));
    return out;
  };
  for (auto& row : reset.at("positions").items(joints)) set.positions.push_back(integers(row));
  set.turns = integers(reset.at("turns"));
  vector<string> every;
  for (auto& each : claim.box) every.push_back(each.first);
  std::set<string> given;
  for (auto& [name, value] : reset.at("numbers").named()) {
    given.insert(name);
    if (value.is(Value::TEXT) && claim.box.count(value.value->text)) set.renamed[name] = value.value->text;
    else set.exact[name] = value.number();
  }
  reset.at("numbers").require(given == std::set<string>(every.begin(), every.end()), "must be the robot's, " + joined(every));
  for (auto& row : reset.at("momentum").items(joints)) {
    set.momentum.emplace_back();
    for (auto& entry : row.items(joints)) set.momentum.back().push_back(read_function(entry, claim.robot.hinge));
    for (auto& f : set.momentum.back())
      for (auto& term : f)
        for (auto& power : std::get<1>(term))
          reset.at("momentum").require(claim.box.count(power.first), "must be of the robot's numbers, " + joined(every));
  }
  return set;
}

Claim read_claim_2(const Node& node) {
  vector<string> names{"robot", "parameters", "limit", "disturbance", "noise", "age", "speed"};
  names.insert(names.end(), LOOP.begin(), LOOP.end());
  names.push_back("push");
  if (node.has("catch")) names.push_back("catch");
  else names.insert(names.end(), AT_GOAL.begin(), AT_GOAL.end());
  Claim claim;
  claim.first_order = node.has("jerk");
  if (claim.first_order) names.insert(names.end(), {"jerk", "reaction", "jumps"});
  if (node.has("keep_out")) names.push_back("keep_out");
  if (node.has("shifts")) names.push_back("shifts");
  node.keys(names);
  node.digests();
  claim.robot = read_robot(node.at("robot"));
  Node parameters = node.at("parameters");
  std::set<string> given, used = claim.robot.numbers();
  for (auto& [name, value] : parameters.named()) {
    claim.parameters.push_back({name, value.range()});
    given.insert(name);
  }
  parameters.require(given == used, "must be the robot's, " + joined({used.begin(), used.end()}));
  claim.box = {claim.parameters.begin(), claim.parameters.end()};
  for (auto& [name, ends] : claim.box)
    if (ends.first < ends.second) claim.uncertain.push_back(name);
  parameters.require(claim.uncertain.size() <= MOST_UNCERTAIN, "has more than " + std::to_string(MOST_UNCERTAIN) + " uncertain numbers");
  claim.limits = node.at("limit").range();
  node.at("limit").require(claim.limits.first > 0, "must be > 0");
  require(mass_is_definite(claim.robot, claim.box), node.place + ".robot.mass", "its determinant is not shown to be positive");
  claim.disturbance = node.at("disturbance").at_least_zero();
  for (auto& each : node.at("noise").items(long(claim.robot.states.size()))) claim.noise.push_back(each.at_least_zero());
  claim.age = node.at("age").at_least_zero(), claim.speed = node.at("speed").at_least_zero();
  claim.push = node.at("push").at_least_zero();
  if (claim.first_order) {
    claim.jerk = node.at("jerk").at_least_zero(), claim.reaction = node.at("reaction").at_least_zero();
    for (auto& each : node.at("jumps").items(long(node.at("u").items().size()))) claim.jumps.push_back(each.at_least_zero());
  }
  if (node.has("keep_out"))
    for (auto& each : node.at("keep_out").items(-1, 1)) claim.keep_out.push_back(read_set(each, long(claim.robot.states.size())));
  if (node.has("shifts")) claim.shifts = read_shifts(node.at("shifts"), claim, long(node.at("x").items().size()));
  if (node.has("catch")) claim.caught = read_catch(node.at("catch"), claim);
  read_loop(node, claim);
  return claim;
}

bool is_case(const string& name) {  // ((free|high|low)[-+]?(late)?|caught)(/n(,n)*)?
  size_t i = 0;
  auto next = [&](const string& word) {
    bool there = name.compare(i, word.size(), word) == 0;
    if (there) i += word.size();
    return there;
  };
  if (!next("caught")) {
    if (!next("free") && !next("high") && !next("low")) return false;
    if (!next("-")) next("+");
    next("late");
  }
  if (i == name.size()) return true;
  if (!next("/")) return false;
  for (;;) {
    size_t from = i;
    while (i < name.size() && name[i] >= '0' && name[i] <= '9') i++;
    if (i == from || i > from + 3) return false;
    if (i == name.size()) return true;
    if (!next(",")) return false;
  }
}

Gram read_squares(const Node& node, int n, int halvings = 0) {
  Gram proof;
  if (node.is(Value::LIST)) {
    node.require(halvings < MOST_HALVINGS, "halves the interval more than " + std::to_string(MOST_HALVINGS) + " times");
    for (auto& half : node.items(2)) proof.halves.push_back(read_squares(half, n, halvings + 1));
    return proof;
  }
  vector<string> parts{"degree", "gram", "multipliers"};
  if (node.is(Value::OBJECT) && node.has("further")) parts.push_back("further");
  node.exactly(parts);
  proof.degree = int(node.at("degree").integer(1, MAX_ORDER / 2));
  if (parts.size() == 4) {
    auto listed = node.at("further").items(-1, 1);
    node.at("further").require(listed.size() <= MOST_FURTHER, "must have at most " + std::to_string(MOST_FURTHER) + " monomials");
    for (auto& each : listed) {
      auto exponents = each.items(n);
      Key key = 0;
      for (int i = 0; i < n; i++) key += power(i, int(exponents[size_t(i)].integer(0, MAX_ORDER / 2)));
      proof.further.push_back(key);
    }
  }
  size_t rows = monomials(n, proof.degree).size() + proof.further.size(), sides = monomials(n, proof.degree - 1).size();
  auto grams = node.at("gram").items(-1, 1);
  grams[0].require(grams.size() <= MOST_GRAMS, "must have at most " + std::to_string(MOST_GRAMS) + " matrices");
  for (auto& each : grams) proof.gram.push_back(each.symmetric(rows));
  for (auto& each : node.at("multipliers").items()) {
    proof.multipliers.emplace_back();
    for (auto& matrix : each.items(-1, 1)) proof.multipliers.back().push_back(matrix.symmetric(sides));
  }
  return proof;
}

void read_cases(const Node& node, int n, vector<string>& names, std::map<string, Gram>& cases) {
  node.require(node.is(Value::OBJECT) && std::all_of(node.value->keys.begin(), node.value->keys.end(), is_case), "must be cases");
  names = node.value->keys;
  for (auto& name : names) cases.emplace(name, read_squares(node.at(name), n));
}

// Each of m numbers of a robot counts as `stride` powers of y.
void require_few_terms(const Node& node, long n, long s_order, long y_order, long m = 0, long stride = 1) {
  Z terms = 0;
  for (long k = 0; k <= (m ? y_order / stride : 0); k++)
    terms += binomial((unsigned long)(k ? m + k - 1 : 0), (unsigned long)k) * binomial((unsigned long)(y_order - stride * k + n), (unsigned long)n);
  terms *= s_order + 1;
  node.require(terms <= MAX_TERMS, "asks for polynomials of " + terms.get_str() + " terms, must be at most " + std::to_string(MAX_TERMS));
}

Interval read_interval(const Node& node, const Claim& claim) {
  vector<string> names{"knot", "start", "end", "first", "last", "bend", "orders", "cases"};
  if (claim.first_order) names.push_back("late");
  if (claim.ellipsoids()) names.push_back("sides");
  node.keys(names);
  node.digests();
  long n = long(claim.n());
  Interval piece;
  for (auto& order : node.at("orders").items(claim.shifts.empty() ? 2 : 3 + long(claim.uncertain.size()))) piece.orders.push_back(int(order.integer(1, MAX_ORDER - 1)));
  if (claim.shifts.empty()) require_few_terms(node.at("orders"), n, piece.orders[0], piece.orders[1]);
  else require_few_terms(node.at("orders"), n, piece.orders[0], piece.orders[1], long(claim.uncertain.size()), piece.orders[2]);
  piece.knot = node.at("knot").integer(0, long(claim.u.size()) - 1);
  piece.start = node.at("start").number(), piece.end = node.at("end").number();
  piece.first = node.at("first").matrix(n, n), piece.last = node.at("last").matrix(n, n);
  auto bend = node.at("bend").items(2);
  for (int i : {0, 1}) piece.bend[i] = bend[size_t(i)].matrix(n, n);
  read_cases(node.at("cases"), int(n), piece.names, piece.cases);
  if (claim.first_order) piece.late = node.at("late").matrix(2, n);
  if (claim.ellipsoids()) piece.sides = read_sides(node.at("sides"), claim, 2);
  node.require(0 <= piece.start && piece.start < piece.end && piece.end <= 1,
               "must start before it ends, at fractions of its interval in [0, 1]");
  return piece;
}

Goal read_goal(const Node& node, const Claim& claim) {
  vector<string> names{"axes", "order", "weight", "shells"};
  bool ended = node.has("rest");
  if (ended) names.push_back("rest");
  if (claim.first_order) names.push_back("late");
  if (claim.ellipsoids()) names.push_back("sides");
  node.keys(names);
  Goal goal;
  if (ended) goal.rest = node.at("rest").number();
  auto shells = node.at("shells").items(-1, 1);
  for (auto& each : shells) {
    each.keys({"start", "end", "cases"});
    each.digests();
    Shell shell;
    shell.start = each.at("start").number(), shell.end = each.at("end").number();
    read_cases(each.at("cases"), int(claim.n()), shell.names, shell.cases);
    each.require(0 <= shell.start && shell.start < shell.end && shell.end <= 1, "must have levels that rise within [0, 1]");
    goal.shells.push_back(std::move(shell));
  }
  node.digests();
  if (claim.moves_the_goal()) node.require(goal.rest > 0, "must have a rest > 0: what acts on the robot moves it at the goal");
  Q reached = goal.rest;
  for (size_t i = 0; i < shells.size(); i++) {
    shells[i].require(goal.shells[i].start == reached, "starts at " + formatted("%g", rounded(goal.shells[i].start)) +
                                                           ", must start at " + formatted("%g", rounded(reached)));
    reached = goal.shells[i].end;
  }
  node.at("shells").require(reached == 1, "ends at " + formatted("%g", rounded(reached)) + ", must end at 1");
  goal.order = int(node.at("order").integer(2, MAX_ORDER - 2));
  require_few_terms(node.at("order"), long(claim.n()), 0, goal.order);  // each power of y has the same one of l
  goal.axes = node.at("axes").matrix(long(claim.n()), long(claim.n()));
  goal.weight = node.at("weight").number();
  if (claim.first_order) goal.late = node.at("late").row(long(claim.n()));
  if (claim.ellipsoids()) goal.sides = read_sides(node.at("sides"), claim, 1);
  return goal;
}

// The verdict ----------------------------------------------------------------------------------------------------------

Q margins(const Named<Obligation>& todo, const std::map<string, Gram>& cases, const vector<string>& names, int n, const string& place) {
  bool same = todo.size() == cases.size();
  vector<string> expected;
  for (auto& [name, one] : todo) same = same && cases.count(name), expected.push_back(name);
  require(same, place, "must have the cases " + joined(expected) + ", has " + joined(names));
  std::optional<Q> least;
  for (auto& [name, one] : todo) {
    Q found = margin(one, cases.at(name), n, place + "." + name);
    if (!least || found < *least) least = found;
  }
  return *least;
}

// The intervals cover [start, t_N] without gap or overlap, and their ellipsoids join.
void require_chain(const Claim& claim, const vector<Interval>& funnel, const string& place) {
  Q reached = claim.first_knot + claim.start;
  const Matrix* axes = nullptr;
  for (size_t i = 0; i < funnel.size(); i++) {
    string here = place + "[" + std::to_string(i) + "]";
    Q begins = funnel[i].knot + funnel[i].start;
    string where = "starts at " + formatted("%.17g", rounded(begins)) + " knots, must start at " + formatted("%.17g", rounded(reached));
    require(begins <= reached, here, "leaves a gap: " + where);
    require(begins == reached, here, "overlaps: " + where);
    require(!axes || *axes == funnel[i].first, here + ".first", "is not where the interval before it ends");
    reached = funnel[i].knot + funnel[i].end;
    axes = &funnel[i].last;
  }
  require(reached == long(claim.u.size()), place, "does not reach the last knot");
}

struct Report {
  Claim claim;
  string digest;
  size_t intervals, shells;
  double start, end, margin, inlet, sum, integral, last;  // volumes; `last` of the goal region or the catch set
  Matrix first;                                           // the axes of the inlet
  std::map<string, vector<double>> widths;
  vector<double> rest;
  vector<std::pair<string, string>> notes;
};

vector<double> widths_of(const Matrix& axes, const Q& times = 1) {
  vector<double> out;
  for (auto& row : axes) out.push_back(rounded(times * exactly(root_up(dot(row, row)))));
  return out;
}

// The region in which a motion ends, or is caught; how close to the goal it comes, by state; the least margin.
struct Ended {
  Matrix region;
  size_t shells = 0;
  vector<double> rest;
  Q least;
};

Ended check_goal(const Claim& claim, const Node& node, const Matrix& outlet) {
  int n = int(claim.n());
  Goal goal = read_goal(node, claim);
  for (int i = 0; i < n; i++) {
    if (!claim.bounds[size_t(i)]) continue;
    Q left = *claim.bounds[size_t(i)] - abs(claim.x_goal[size_t(i)]);
    const Row& row = goal.axes[size_t(i)];
    require(left > 0 && left * left > dot(row, row), node.place + ".axes", "the limit on |" + printable(claim.robot.states[size_t(i)]) + "| is not kept");
  }
  size_t ellipsoid = 0;
  for (size_t j = 0; j < claim.keep_out.size(); j++) {
    const KeptOut& each = claim.keep_out[j];
    const Row w = each.half ? each.normal : goal.sides[ellipsoid++][0];
    Q left = each.half ? each.offset : Q(-each.support(w)), square = 0;
    for (size_t i = 0; i < size_t(n); i++) left += w[i] * ((each.half ? Q(0) : each.center[i]) - claim.x_goal[i]);
    for (size_t column = 0; column < size_t(n); column++) {
      Q turned = 0;
      for (size_t i = 0; i < size_t(n); i++) turned += w[i] * goal.axes[i][column];
      square += turned * turned;
    }
    require(left > 0 && left * left > square, node.place + ".axes", "the set claim.keep_out[" + std::to_string(j) + "] is not kept out of");
  }
  GoalField field;
  goal_field(claim, goal, node.place, field);
  for (auto& center : last_centers(claim)) require_arrival(claim, outlet, goal, center, node.place + ".axes");
  std::optional<Q> least;
  Q drift = 0;
  for (size_t i = 0; i < goal.shells.size(); i++) {
    const Shell& shell = goal.shells[i];
    auto todo = goal_obligations(claim, field, shell.start, shell.end, are_joined(shell.names));
    Q found = margins(todo, shell.cases, shell.names, n, node.place + ".shells[" + std::to_string(i) + "].cases");
    least = least ? std::min(*least, found) : found;
    for (auto& [name, one] : todo) drift = std::max(drift, one.drift);
  }
  Q rest = std::max(goal.rest, Q(drift / *least));
  require(rest < 1, node.place, "the rounding of the goal is too large for a proof");
  return {goal.axes, goal.shells.size(), widths_of(goal.axes, rest), *least};
}

Ended check_catch(const Claim& claim, const Node& node, const Matrix& outlet) {
  node.keys({"order", "cases"});
  node.digests();
  int order = int(node.at("order").integer(2, MAX_ORDER - 2)), n = int(claim.n());
  require_few_terms(node.at("order"), n, 0, order);  // each power of y has the same one of l
  vector<string> names;
  std::map<string, Gram> cases;
  read_cases(node.at("cases"), n, names, cases);
  return {claim.caught->axes, 0, {}, margins(catch_obligations(claim, outlet, order, node.place), cases, names, n, node.place + ".cases")};
}

Report check(const Value& content) {
  Node top{"certificate", &content};
  top.require(top.is(Value::OBJECT), "must be an object");
  auto stated = [&](const char* key, Value::Kind kind, const char* text) {
    const Value* value = content.find(key);
    return value && value->kind == kind && value->text == text;
  };
  top.require(stated("format", Value::TEXT, "rtcd certificate"), "is no 'rtcd certificate'");
  bool first = stated("version", Value::INTEGER, "1");
  top.require(first || stated("version", Value::INTEGER, "2"), "must be of version 1 or 2");
  bool caught = top.has("catch");
  top.keys({"format", "version", "claim", "funnel", caught ? "catch" : "goal", "notes"});
  Report report;
  Node notes = top.at("notes");
  notes.require(notes.is(Value::OBJECT), "must be an object");
  notes.require(notes.value->keys.size() <= MAX_NOTES, "has " + std::to_string(notes.value->keys.size()) + " entries, must have at most " + std::to_string(MAX_NOTES));
  for (size_t i = 0; i < notes.value->keys.size(); i++) {
    notes.require(notes.value->parts[i].kind == Value::TEXT, "must hold texts");
    report.notes.push_back({notes.value->keys[i], notes.value->parts[i].text});
  }
  Node about = top.at("claim");
  bool names_its_robot = about.has("plant");
  report.claim = names_its_robot ? read_claim_1(about) : read_claim_2(about);
  Claim& claim = report.claim;
  for (auto& each : claim.parameters) claim.box[each.first] = each.second;
  top.require(names_its_robot == first, "has the claim of another version");
  vector<Interval> funnel;
  for (auto& item : top.at("funnel").items(-1, 1)) funnel.push_back(read_interval(item, claim));
  string place = top.place + ".funnel";
  require_chain(claim, funnel, place);

  int n = int(claim.n());
  top.require(claim.caught.has_value() == caught, string("must have a ") + (caught ? "goal" : "catch") + ", as its claim has");
  Ended end = (caught ? check_catch : check_goal)(claim, top.at(caught ? "catch" : "goal"), funnel.back().last);
  Q least = end.least;

  Q integral = 0;
  for (size_t i = 0; i < funnel.size(); i++) {
    string here = place + "[" + std::to_string(i) + "]";
    Motion on = motion(claim, funnel[i]);
    require_bounds(claim, on, here);
    require_kept_out(claim, funnel[i], on, here);
    if (claim.push != 0) require_push(claim, funnel[i], on, here);
    if (claim.first_order) require_jump(claim, funnel[i], here);
    auto todo = funnel_obligations(claim, funnel[i], on, here);
    least = std::min(least, margins(todo, funnel[i].cases, funnel[i].names, n, here + ".cases"));
    Curve determinant = cofactors(on.axes, Curve{1}).second;
    for (size_t k = 0; k < determinant.size(); k += 2) integral += determinant[k] / Q(long(k + 1)) * on.duration;
  }
  top.digests();

  double ball = std::pow(M_PI, n / 2.0) / std::tgamma(n / 2.0 + 1);
  auto volume = [&](const Matrix& axes) { return ball * rounded(cofactors(axes, Q(1)).second); };
  long double sum = volume(funnel.back().last);
  for (auto& piece : funnel)
    if (piece.start == 0) sum += volume(piece.first);
  report.digest = digest(*about.value);
  report.intervals = funnel.size(), report.shells = end.shells;
  report.start = rounded((claim.first_knot + claim.start) * claim.dt);
  report.end = rounded(Q(long(claim.u.size())) * claim.dt);
  report.margin = rounded(least);
  report.inlet = volume(funnel[0].first), report.last = volume(end.region), report.first = funnel[0].first;
  report.sum = double(sum), report.integral = ball * rounded(integral);
  report.widths = {{"inlet", widths_of(funnel[0].first)}, {"outlet", widths_of(funnel.back().last)}, {caught ? "catch" : "goal", widths_of(end.region)}};
  report.rest = end.rest;
  return report;
}

// What is proved, in plain words ---------------------------------------------------------------------------------------

string quoted(const string& text) {  // as Python shows it
  bool doubled = text.find('\'') != string::npos && text.find('"') == string::npos;
  string out(1, doubled ? '"' : '\'');
  for (char c : text) {
    if (c == '\\' || (c == '\'' && !doubled)) out += '\\';
    out += c;
  }
  return out + (doubled ? '"' : '\'');
}

string sentence(const Report& report) {
  const Claim& claim = report.claim;
  const Robot& robot = claim.robot;
  auto six = [](double x) { return formatted("%.6g", x); };
  auto number = [&](const Q& q) { return six(rounded(q)); };
  string input = printable(robot.input_unit), unit, numbers, bounds, acts, comes, push;
  for (auto& each : robot.units) unit += (unit.empty() ? "" : " ") + printable(each);
  auto widths = [&](const vector<double>& half) {
    string text;
    for (size_t i = 0; i < half.size(); i++)
      text += (i ? ", " : "") + printable(robot.states[i]) + " +-" + formatted("%.3g", half[i]) + " " + printable(robot.units[i]);
    return text;
  };
  for (auto& [name, ends] : claim.parameters) {
    string low = number(ends.first), high = number(ends.second);
    numbers += (numbers.empty() ? "" : ", ") + printable(name) + (ends.first == ends.second ? " = " + low : " in [" + low + ", " + high + "]");
  }
  string robots = claim.uncertain.empty()
                      ? "the model " + quoted(printable(robot.name)) + " (" + numbers + "; SI units)"
                      : "every robot " + quoted(printable(robot.name)) + " with " + numbers + " (SI units; " +
                            (claim.constant() ? "constant" : "constant or varying") + " in time)";
  for (size_t i = 0; i < claim.n(); i++)
    if (claim.bounds[i])
      bounds += (bounds.empty() ? "" : " and ") + ("|" + printable(robot.states[i]) + "| <= " + number(*claim.bounds[i]) + " " + printable(robot.units[i]));
  for (auto& each : claim.keep_out) {
    string terms;
    for (size_t i = 0; i < claim.n(); i++) {
      string state = printable(robot.states[i]), plus = terms.empty() ? "" : " + ";
      if (each.half && each.normal[i] != 0) terms += plus + number(each.normal[i]) + " " + state;
      if (!each.half && each.semi_axes[i]) terms += plus + "((" + state + " - " + number(each.center[i]) + ") / " + number(*each.semi_axes[i]) + ")^2";
    }
    bounds += (bounds.empty() ? "" : " and ") + terms + (each.half ? " <= " + number(each.offset) : " >= 1");
  }
  string least = number(claim.limits.first), largest = number(claim.limits.second);
  string limit = least == largest ? largest + " " + input : "a limit in [" + least + ", " + largest + "] " + input;
  if (claim.disturbance != 0) acts += ", for every disturbance |w(t)| <= " + number(claim.disturbance) + " " + input + " on top of the motor";
  string errors;
  for (size_t i = 0; i < claim.n(); i++)
    if (claim.noise[i] != 0)
      errors += (errors.empty() ? "" : ", ") + printable(robot.states[i]) + " +-" + formatted("%.3g", rounded(claim.noise[i])) + " " + printable(robot.units[i]);
  if (!errors.empty()) acts += ", for every error of the measured state within " + errors;
  if (claim.age != 0)
    acts += ", for feedback whose state was measured at most " + number(claim.age) +
            " s ago, under the controller in charge and not before the motion began";
  if (!claim.caught)
    comes = claim.moves_the_goal() ? "comes and stays within " + widths(report.rest) + " of the goal"
                                 : "converges to within " + formatted("%.1g", *std::max_element(report.rest.begin(), report.rest.end())) +
                                       " of the goal in every state";
  string ends = " s, never leaves that region, and " + comes;
  if (claim.caught)
    ends = string(" until ") + six(report.end) + " s, where " + (claim.caught->resets ? "the claimed reset leads it into" : "it is in") + " the catch set";
  else
    ends = ", is in the goal region at " + six(report.end) + ends;
  string times = "[" + six(report.start) + " s, " + six(report.end) + " s]";
  if (claim.push != 0)
    push = string(" A state ") + (claim.shifts.empty() ? "on the nominal motion" : "at the center of its robot's funnel") +
           " that an impulse of up to " + number(claim.push) + " " + input + " s on the motor hits, once and at any instant of " + times + ", stays in the funnel.";
  string funnel = claim.shifts.empty() ? "the funnel" : "the funnel of its robot, all of one size, each about its own center,";
  bool noisy = !errors.empty();
  string extents;
  const char* last = claim.caught ? "catch" : "goal";
  for (const char* place : {"inlet", "outlet", last}) extents += (extents.empty() ? "" : "; ") + (place + (" " + widths(report.widths.at(place))));
  return "PROVED in continuous time, by exact arithmetic, for " + robots + " under the claimed controller, whose input never exceeds " +
         limit + acts + ": every motion that is in " + funnel + " at some time of " + times + " stays in it" + ends + "; " + (bounds.empty() ? "there is no limit on a state" : bounds) +
         " all the while." + push + " Half widths: " + extents + ". Volumes (proved) [" + unit + "]: inlet " + six(report.inlet) +
         ", sum over the knots " + six(report.sum) + ", integral over time " + six(report.integral) + " s, " +
         (claim.caught ? "catch set " : "goal region ") + six(report.last) + ". " + std::to_string(report.intervals) + " intervals of time" +
         (claim.caught ? "" : " and " + std::to_string(report.shells) + " of level") + ", smallest margin " +
         formatted("%.2g", report.margin) + ". It is a statement about " + (claim.uncertain.empty() ? "this model, its" : "these models, their") +
         " state " + (noisy ? "known up to these errors" : "known exactly") + " and " +
         (claim.age != 0 ? "its feed-forward in time" : "its input applied without sampling") + ", not about hardware. Claim: sha256 " + report.digest + ".";
}

// Cycles ---------------------------------------------------------------------------------------------------------------

// That proved motions follow one another in this order, the first one after the last.
void require_cycle(const vector<Report>& reports) {
  for (size_t i = 0; i < reports.size(); i++) {
    const Claim &claim = reports[i].claim, &ahead = reports[(i + 1) % reports.size()].claim;
    string place = "certificate " + std::to_string(i + 1);
    require(claim.caught && claim.caught->resets, place, "does not end in a reset");
    const Catch& set = *claim.caught;
    require(ahead.first_knot == 0 && ahead.start == 0, place, "is followed by one that is not proved from t = 0 on");
    require(set.center == ahead.x[0] && set.axes == reports[(i + 1) % reports.size()].first, place,
            "its catch set is not the first ellipsoid of the one that follows");
    const Robot &a = claim.robot, &b = ahead.robot;
    require(std::tie(a.name, a.input_unit, a.states, a.units, a.hinge, a.mass, a.potential, a.damping, a.motor) ==
                std::tie(b.name, b.input_unit, b.states, b.units, b.hinge, b.mass, b.potential, b.damping, b.motor),
            place, "is followed by one about another robot");
    Box after;
    for (auto& [name, value] : set.exact) after[name] = {value, value};
    for (auto& [name, other] : set.renamed) after[name] = claim.box.at(other);
    require(after == ahead.box, place, "the robot's numbers after its reset are not those of the one that follows");
    require(claim.limits == ahead.limits, place, "is followed by one with another limit of the motor");
  }
}

string cycle_sentence(const vector<Report>& reports) {
  bool one = reports.size() == 1;
  string digests;
  for (auto& report : reports) digests += (digests.empty() ? "" : ", ") + report.digest;
  return "PROVED that " + (one ? string("this motion is") : "these " + std::to_string(reports.size()) + " motions are") +
         " a cycle: what the reset at the end makes of the last ellipsoid lies in " +
         (one ? "its first one" : "the first one of the motion that follows, of the last in the first") +
         ". A robot that is in a funnel at some time stays in the funnels for ever, motion after motion, if each reset comes at its "
         "instant and is as claimed. Claims: sha256 " + digests + ".";
}

// The command ----------------------------------------------------------------------------------------------------------

string gave_up;

void leave(const string& line) {
  ssize_t written = write(2, line.data(), line.size());
  _exit(written >= 0 ? 2 : 2);
}

string read_file(const string& path) {
  string content;
  int file = open(path.c_str(), O_RDONLY);
  if (file < 0) throw std::make_pair(path, errno);
  static char buffer[1 << 16];
  for (;;) {
    ssize_t count = read(file, buffer, sizeof buffer);
    if (count < 0 && errno == EINTR) continue;
    if (count < 0) throw std::make_pair(path, errno);
    if (count == 0) break;
    content.append(buffer, size_t(count));
    if (long(content.size()) > MAX_BYTES) throw Undecided{"has more than " + std::to_string(MAX_BYTES) + " bytes: undecided"};
  }
  close(file);
  return content;
}

Value content_of(const string& path) {
  string bytes = read_file(path);
  return Reader(bytes).whole();
}

const char* USAGE =
    "usage: check FILE [--seconds N]\n       check --cycle FILE FILE [...] [--seconds N]\n\n"
    "Check a certificate by exact arithmetic. Exit code 0 only if all of it holds; 1 if it is refused, with the place and\n"
    "the reason; 2 if it is undecided or there is nothing to read.\n\n"
    "  --seconds N  give up after so many seconds of wall clock [s] (> 0, default 600)\n"
    "  --cycle      also: does each motion end where the next one begins, the last where the first does?\n";

int main(int count, char** words) {
  string seconds = "600";
  vector<string> files;
  bool cycle = false;
  for (int i = 1; i < count; i++) {
    string word = words[i];
    if (word == "-h" || word == "--help") return std::printf("%s", USAGE), 0;
    if (word == "--seconds" && i + 1 < count) seconds = words[++i];
    else if (word.rfind("--seconds=", 0) == 0) seconds = word.substr(10);
    else if (word == "--cycle") cycle = true;
    else if (word.rfind("--", 0) == 0) return std::fprintf(stderr, "check: %s: must be files, --seconds N or --cycle\n", printable(word).c_str()), 2;
    else files.push_back(word);
  }
  char* end = nullptr;
  double limit = std::strtod(seconds.c_str(), &end);
  if (seconds.empty() || *end || !(limit > 0 && limit <= 1e6))
    return std::fprintf(stderr, "check: --seconds %s: must be a number > 0 and <= 1e6\n", printable(seconds).c_str()), 2;
  if (files.empty() || (files.size() > 1 && !cycle)) return std::fprintf(stderr, "check: must have a file, or with --cycle some\n%s", USAGE), 2;
  string name = printable(files[0]);
  gave_up = name + ": gave up after " + formatted("%g", limit) + " s: undecided; --seconds gives it more\n";
  std::signal(SIGALRM, [](int) { leave(gave_up); });
  itimerval timer{};
  timer.it_value.tv_sec = long(limit);
  timer.it_value.tv_usec = std::max(1L, long((limit - std::floor(limit)) * 1e6));
  setitimer(ITIMER_REAL, &timer, nullptr);
  static string no_memory = name + ": needs more memory than there is: undecided\n";
  mp_set_memory_functions(
      [](size_t n) {
        void* p = std::malloc(n);
        if (!p) leave(no_memory);
        return p;
      },
      [](void* old, size_t, size_t n) {
        void* p = std::realloc(old, n);
        if (!p) leave(no_memory);
        return p;
      },
      nullptr);
  try {
    vector<Report> reports;
    for (auto& file : files) {
      name = printable(file);
      reports.push_back(check(content_of(file)));
    }
    if (cycle) require_cycle(reports);
    for (auto& report : reports) {
      std::printf("%s\n", sentence(report).c_str());
      for (auto& [key, text] : report.notes)
        std::printf("%s\n", printable("note of the file's author, not proved: " + key + ": " + text, LONGEST_NOTE).c_str());
    }
    if (cycle) std::printf("%s\n", cycle_sentence(reports).c_str());
    return 0;
  } catch (const Refused& refused) {
    std::fprintf(stderr, "REFUSED %s\n%s\n", name.c_str(), printable(refused.place + ": " + refused.reason).c_str());
    return 1;
  } catch (const Undecided& undecided) {
    std::fprintf(stderr, "%s: %s\n", name.c_str(), undecided.reason.c_str());
  } catch (const std::pair<string, int>& missing) {
    std::fprintf(stderr, "%s: %s; a certificate is RUN/certificates/NNN.json\n", name.c_str(), std::strerror(missing.second));
  } catch (const std::bad_alloc&) {
    leave(no_memory);
  }
  return 2;
}
