"""The second checker, check.cpp: the same files, the same theorem, another language and no shared line.

    g++ -O1 -std=c++17 check.cpp -lgmpxx -lgmp -o check && ./check FILE

`rtcd check FILE --second` builds and runs it beside the first one.
"""
