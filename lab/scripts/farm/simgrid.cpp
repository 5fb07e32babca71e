// A farm in SimGrid: workers ask a master over a network, the master sends one task after another, workers compute.
// Replays the list schedule of `entire-lab farm-simulate --arrival --overhead 0`, and prints its makespan.
//
//   simgrid SECONDS.txt SLOTS LATENCY DISPATCH
//
// SECONDS.txt has one line per task with its seconds, in the order in which tasks are sent. LATENCY and DISPATCH are
// seconds.
#include <algorithm>
#include <cstdio>
#include <fstream>
#include <memory>
#include <simgrid/s4u.hpp>
#include <string>
#include <vector>

namespace sg4 = simgrid::s4u;

static double last_end = 0.0;

static sg4::Mailbox* box_of(int worker) { return sg4::Mailbox::by_name("worker-" + std::to_string(worker)); }

static void master(const std::vector<double>& tasks, int slots, double dispatch) {
    auto* asks = sg4::Mailbox::by_name("asks");
    for (double seconds : tasks) {
        std::unique_ptr<int> who(asks->get<int>());
        sg4::this_actor::sleep_for(dispatch);
        box_of(*who)->put_init(new double(seconds), 1)->detach();
    }
    for (int i = 0; i < slots; ++i) {
        std::unique_ptr<int> who(asks->get<int>());
        box_of(*who)->put_init(new double(-1.0), 1)->detach();
    }
}

static void worker(int number) {
    auto* asks = sg4::Mailbox::by_name("asks");
    for (;;) {
        asks->put(new int(number), 1);
        std::unique_ptr<double> seconds(box_of(number)->get<double>());
        if (*seconds < 0.0) return;
        sg4::this_actor::execute(*seconds);
        last_end = std::max(last_end, sg4::Engine::get_clock());
    }
}

int main(int argc, char** argv) {
    sg4::Engine engine(&argc, argv);
    // Latencies and bandwidths as given, without factors fitted to TCP.
    sg4::Engine::set_config("network/model:CM02");
    if (argc != 5) {
        std::fprintf(stderr, "usage: simgrid SECONDS.txt SLOTS LATENCY DISPATCH\n");
        return 2;
    }
    std::ifstream file(argv[1]);
    std::vector<double> tasks;
    for (double seconds; file >> seconds;) tasks.push_back(seconds);
    const int slots = std::stoi(argv[2]);
    const double latency = std::stod(argv[3]), dispatch = std::stod(argv[4]);
    auto* zone = sg4::create_full_zone("farm");
    auto* head = zone->create_host("head", 1e9);
    auto link = [&](const char* name, double seconds) {
        auto* made = zone->create_link(name, 1e15)->set_latency(seconds);
        made->set_sharing_policy(sg4::Link::SharingPolicy::FATPIPE);
        return made->seal();
    };
    auto* up = link("up", 0.0);
    auto* down = link("down", latency);
    std::vector<sg4::Host*> hosts;
    for (int i = 0; i < slots; ++i) {
        // A host computes one operation per second, so that the number of a task's operations is its seconds.
        auto* host = zone->create_host("node-" + std::to_string(i), 1.0);
        zone->add_route(host->get_netpoint(), head->get_netpoint(), nullptr, nullptr, {sg4::LinkInRoute(up)}, false);
        zone->add_route(head->get_netpoint(), host->get_netpoint(), nullptr, nullptr, {sg4::LinkInRoute(down)}, false);
        hosts.push_back(host);
    }
    zone->seal();
    sg4::Actor::create("master", head, [&] { master(tasks, slots, dispatch); });
    for (int i = 0; i < slots; ++i) sg4::Actor::create("worker", hosts[i], [i] { worker(i); });
    engine.run();
    std::printf("%.9f\n", last_end);
    return 0;
}
